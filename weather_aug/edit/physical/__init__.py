"""The editor that needs no weights."""
