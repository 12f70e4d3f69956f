"""The same bytes on any number of threads or workers, however started, and on older CPUs.

A lower CPU level is simulated by what each library offers for it. That a setting bites is seen in
canaries: functions of numpy, BLAS and OpenCV whose bits do depend on it.
"""

from __future__ import annotations

import hashlib
import json
import multiprocessing
import os
import platform
import subprocess
import sys
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from typing import Any

import bits_probe
import pytest
from bits_probe import CASES, digests
from torch.utils.data import DataLoader

import weather_aug
from weather_aug.scene.policy import WeatherPolicy
from weather_aug.scene.scene import WeatherScene
from weather_aug.transforms.dataset import WeatherDataset

TIMEOUT_S = 600
THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS")
NO_AVX512 = "X86_V4 AVX512_ICL AVX512_SPR"
LIBRARIES = {
    "numpy without AVX-512": {"NPY_DISABLE_CPU_FEATURES": NO_AVX512},
    "numpy without AVX2": {"NPY_DISABLE_CPU_FEATURES": f"X86_V3 {NO_AVX512}"},
    "OpenCV without AVX-512": {"OPENCV_CPU_DISABLE": "AVX512-SKX"},
    "OpenCV without AVX2": {"OPENCV_CPU_DISABLE": "AVX512-SKX,AVX2,FP16,AVX,SSE4.2,SSE4.1,SSSE3"},
    "OpenCV without IPP": {"OPENCV_IPP": "disabled"},
    "BLAS for Haswell": {"OPENBLAS_CORETYPE": "Haswell"},
    "BLAS for Nehalem": {"OPENBLAS_CORETYPE": "Nehalem"},
    "torch without AVX-512": {"ATEN_CPU_CAPABILITY": "avx2"},
    "torch without AVX2": {"ATEN_CPU_CAPABILITY": "default"},
    "C library without FMA": {"GLIBC_TUNABLES": "glibc.cpu.hwcaps=-AVX2,-FMA,-FMA4,-AVX"},
}
COMPILERS = {
    name: {"NUMBA_CPU_NAME": name, "NUMBA_CPU_FEATURES": ""}
    for name in ("x86-64-v4", "x86-64-v3", "x86-64-v2", "generic")
}
OLD = {
    **LIBRARIES["numpy without AVX2"],
    **LIBRARIES["OpenCV without AVX2"],
    **LIBRARIES["OpenCV without IPP"],
    **LIBRARIES["BLAS for Nehalem"],
    **LIBRARIES["torch without AVX2"],
    **LIBRARIES["C library without FMA"],
    **COMPILERS["x86-64-v2"],
}
"""All at once: a CPU of 2009."""
LEVELS = LIBRARIES | COMPILERS | {"all at once": OLD}
on_x86 = pytest.mark.skipif(
    platform.machine() not in ("x86_64", "AMD64"), reason="CPU levels are simulated on x86-64 only"
)
forks = pytest.mark.filterwarnings(
    "ignore:This process .* is multi-threaded, use of fork:DeprecationWarning"
)


@pytest.fixture(scope="module")
def here() -> dict[str, str]:
    """Digests of all cases, rendered in this process as it is."""
    return digests(list(CASES))


def probed(*arguments: str, **environment: str) -> tuple[dict[str, str], dict[str, str]]:
    """Digests of the cases and of the canaries in a process of another environment."""
    done = subprocess.run(
        [sys.executable, str(Path(bits_probe.__file__)), *arguments],
        env=os.environ | {"PYTHONPATH": str(Path(weather_aug.__file__).parents[1])} | environment,
        capture_output=True,
        text=True,
        timeout=TIMEOUT_S,
    )
    assert done.returncode == 0, done.stderr
    found = json.loads(done.stdout)
    return found["planes"], found["canaries"]


def differing(one: dict[str, str], other: dict[str, str]) -> list[str]:
    assert one.keys() == other.keys()
    return [name for name in one if one[name] != other[name]]


def with_threads(count: int) -> dict[str, str]:
    environment = dict.fromkeys(THREADS, str(count))
    return probed("--threads", str(count), **environment)[0]


def test_cases_differ_from_each_other(here: dict[str, str]) -> None:
    """Equal digests of empty pictures would prove nothing."""
    images = {name: digest for name, digest in here.items() if name.endswith("/image")}
    assert len(set(images.values())) == len(CASES)
    assert len({digest for name, digest in here.items() if name.endswith("/label")}) > 5


def test_eight_threads_change_nothing(here: dict[str, str]) -> None:
    assert differing(here, with_threads(8)) == []


@pytest.mark.slow
@pytest.mark.parametrize("count", [1, 2])
def test_other_thread_counts_change_nothing(here: dict[str, str], count: int) -> None:
    assert differing(here, with_threads(count)) == []


@on_x86
def test_an_old_cpu_changes_nothing(here: dict[str, str]) -> None:
    """Some cases, because all kernels are compiled once more; `slow` renders all of them."""
    planes, canaries = probed("--cases", "snow-wet,fog-uneven,traffic,unlabelled", **OLD)
    if not differing(bits_probe.canaries(), canaries):
        pytest.skip("this CPU has no level that could be switched off")
    assert differing({name: here[name] for name in planes}, planes) == []


@on_x86
def test_a_picture_made_by_numpys_exp_would_be_seen(here: dict[str, str]) -> None:
    """A planted fault: one numpy function between the tables and the kernels, in float32."""
    environment = LIBRARIES["numpy without AVX2"] | LIBRARIES["C library without FMA"]
    plain, canaries = probed("--cases", "fog", "--fault", **environment)
    if not differing(bits_probe.canaries(), canaries):
        pytest.skip("this CPU has no level that could be switched off")
    with bits_probe.fault():
        faulty = digests(["fog"])
    assert differing(faulty, plain) != []


@pytest.mark.slow
@on_x86
@pytest.mark.parametrize("level", LEVELS)
def test_no_cpu_level_changes_anything(here: dict[str, str], level: str) -> None:
    assert differing(here, probed(**LEVELS[level])[0]) == []


STARTS = [(1, "fork"), (2, "forkserver")]
ALL_STARTS = [
    (workers, method) for method in ("fork", "spawn", "forkserver") for workers in (1, 2, 3, 4, 8)
]


def starts() -> list[Any]:
    """A few by default, all of them slowly."""
    rest = [start for start in ALL_STARTS if start not in STARTS]
    return [*STARTS, *(pytest.param(*start, marks=pytest.mark.slow) for start in rest)]


@forks
@pytest.mark.parametrize(("workers", "method"), starts())
def test_processes_render_alike(here: dict[str, str], workers: int, method: str) -> None:
    context = multiprocessing.get_context(method)
    with ProcessPoolExecutor(workers, mp_context=context) as pool:
        found = list(pool.map(digests, [[name] for name in CASES], timeout=TIMEOUT_S))
    merged = {name: digest for part in found for name, digest in part.items()}
    assert differing(here, merged) == []


def item_digests(loader: DataLoader[Any]) -> list[str]:
    """Of image, label and recipe, in order."""
    found = []
    for batch in loader:
        for image, label, recipe in zip(
            batch["image"], batch["label"], batch["recipe"], strict=True
        ):
            data = image.numpy().tobytes() + label.numpy().tobytes() + recipe.encode()
            found.append(hashlib.sha256(data).hexdigest())
    return found


@forks
@pytest.mark.filterwarnings("ignore:This DataLoader will create")
@pytest.mark.parametrize(
    ("workers", "method"),
    # tests/transforms has those of fork and spawn.
    [
        (2, "forkserver"),
        *(pytest.param(*start, marks=pytest.mark.slow) for start in ALL_STARTS[1:]),
    ],
)
def test_a_loader_gives_the_same_items(tiny_scene: WeatherScene, workers: int, method: str) -> None:
    policy = WeatherPolicy({"rain": 1, "snow": 1, "fog": 1}, severity=(0.5, 1.0), falling=1.0)
    dataset = WeatherDataset([tiny_scene], policy, seed=11, crop=(32, 40))
    loader = DataLoader(
        dataset,
        batch_size=2,
        num_workers=workers,
        multiprocessing_context=method,
        timeout=TIMEOUT_S,
    )
    expected = item_digests(DataLoader(dataset, batch_size=3))
    assert len(set(expected)) == len(dataset) == 8
    assert item_digests(loader) == expected
