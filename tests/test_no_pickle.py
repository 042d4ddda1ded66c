"""Nothing in the package runs what it reads: no pickle, no eval, no loader that would unpickle."""

from __future__ import annotations

import ast
from pathlib import Path

import pytest

PACKAGE = Path(__file__).parents[1] / "apex_bat"
FILES = sorted(PACKAGE.rglob("*.py"))
MODULES = {"pickle", "cPickle", "_pickle", "cloudpickle", "dill", "marshal", "shelve", "joblib", "jsonpickle", "yaml"}
CALLS = {"eval", "exec", "compile", "__import__"}
METHODS = {"recv_pyobj", "send_pyobj", "load_dataset", "read_pickle", "to_pickle"}


def faults(source: str) -> list[str]:
    """Returns what a source has that could run what it reads, each with its line."""
    found = []
    for node in ast.walk(ast.parse(source)):
        names: list[str] = []
        line = getattr(node, "lineno", 0)
        if isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            names = [node.module or ""]
        found += [f"{line}: import {name}" for name in names if name.split(".")[0] in MODULES]
        if isinstance(node, ast.Call) and (fault := _fault(node)):
            found.append(f"{line}: {fault}")
    return found


def _fault(call: ast.Call) -> str:
    name = ast.unparse(call.func)
    owner, _, method = name.rpartition(".")
    given = {keyword.arg: ast.unparse(keyword.value) for keyword in call.keywords}
    if (not owner and name in CALLS) or method in METHODS:
        return name
    if name == "torch.load" and given.get("weights_only") != "True":
        return "torch.load without weights_only=True"
    if name in ("np.load", "numpy.load") and given.get("allow_pickle") != "False":
        return "np.load without allow_pickle=False"
    if given.get("allow_pickle", "False") != "False":
        return "allow_pickle"
    return ""


@pytest.mark.parametrize("path", FILES, ids=lambda path: str(path.relative_to(PACKAGE)))
def test_a_module_runs_nothing_that_it_reads(path: Path) -> None:
    assert faults(path.read_text(encoding="utf-8")) == []


@pytest.mark.parametrize(
    "source",
    [
        "import pickle",
        "from pickle import loads",
        "import joblib.numpy_pickle",
        "eval(text)",
        "exec(text)",
        "torch.load(path)",
        "torch.load(path, weights_only=False)",
        "np.load(path)",
        "np.load(path, allow_pickle=True)",
        "np.savez(file, allow_pickle=True)",
        "socket.recv_pyobj()",
        "import yaml",
    ],
)
def test_the_search_finds(source: str) -> None:
    assert faults(source)


def test_what_is_allowed_is_not_found() -> None:
    assert not faults("import json\nre.compile('a')\nnp.load(p, allow_pickle=False)\ntorch.load(p, weights_only=True)")
