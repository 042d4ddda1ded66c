"""Starts atheris, the fuzzer that is guided by coverage, on one of the modules here."""

from __future__ import annotations

import importlib
import sys


def run(module: str) -> None:
    """Fuzzes with the function `fuzz` of a module until libFuzzer ends; only this package's code guides it.

    Args:
        module: name of a module with a function `fuzz(data: bytes)`.
    """
    import atheris  # type: ignore[import-untyped]

    for name in [name for name in sys.modules if name.startswith(("apex_bat", "tests.fuzz"))]:
        del sys.modules[name]  # imported by the script that called us; once more, and instrumented
    with atheris.instrument_imports(include=["apex_bat"]):
        fuzz = importlib.import_module(module).fuzz
        fuzz(b"")
    atheris.Setup(sys.argv, fuzz)
    atheris.Fuzz()
