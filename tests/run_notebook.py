"""Run a notebook in this very Python: python run_notebook.py NOTEBOOK OUT.

A process of its own, because its sockets are closed by the garbage collector, which warns.
"""

from __future__ import annotations

import sys

import nbformat
from jupyter_client.kernelspec import KernelSpecManager
from jupyter_client.manager import AsyncKernelManager
from nbclient import NotebookClient

CELL_S = 60


def main(source: str, out: str) -> None:
    notebook = nbformat.read(source, as_version=4)
    # No folders: a kernel that somebody installed may be another Python than this one.
    specs = KernelSpecManager(kernel_dirs=[])
    kernel = AsyncKernelManager(kernel_name="python3", kernel_spec_manager=specs)
    NotebookClient(notebook, km=kernel, timeout=CELL_S, startup_timeout=CELL_S).execute()
    nbformat.write(notebook, out)


if __name__ == "__main__":
    main(*sys.argv[1:])
