"""The layout of the source: one direction, no circles, one name for one module."""

from __future__ import annotations

import ast
import re
from collections import Counter
from graphlib import TopologicalSorter
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
FILES = {
    ".".join(path.relative_to(base).with_suffix("").parts).removesuffix(".__init__"): path
    for base, package in ((ROOT / "src", "fmuid"), (ROOT, "fmu_build"))
    for path in (base / package).rglob("*.py")
}


def imported(module: str) -> set[str]:
    """Return the modules of fmuid that a module imports, also those for types only."""
    modules = set()
    for node in ast.walk(ast.parse(FILES[module].read_text())):
        if isinstance(node, ast.Import):
            modules |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{module} has a relative import"
            names = {f"{node.module}.{alias.name}" for alias in node.names}
            modules |= (names & FILES.keys()) or {str(node.module)}
    return modules & FILES.keys()


def package_of(module: str) -> str:
    """Return its folder; `fmuid` and `diagnosis_pipeline` count as packages of their own."""
    inside = FILES[module].name == "__init__.py" or module.count(".") < 2
    return module if inside else module.rpartition(".")[0]


@pytest.fixture(scope="module")
def imports() -> dict[str, set[str]]:
    return {module: imported(module) for module in FILES}


def test_no_module_and_no_package_imports_itself_through_others(imports: dict[str, set[str]]) -> None:
    TopologicalSorter(imports).prepare()  # raises CycleError, which names the circle
    packages: dict[str, set[str]] = {}
    for module, others in imports.items():
        home = package_of(module)
        packages.setdefault(home, set()).update({package_of(other) for other in others} - {home})
    TopologicalSorter(packages).prepare()


def test_a_package_imports_only_those_above_it_in_the_table(imports: dict[str, set[str]]) -> None:
    rows = re.findall(r"^\| `(\w+)` \|", (ROOT / "CONTRIBUTING.md").read_text(), re.MULTILINE)
    order = {name if name == "fmu_build" else f"fmuid.{name}": number for number, name in enumerate(rows)}
    names = {module: ".".join(module.split(".")[: 2 - module.startswith("fmu_build")]) for module in FILES}
    assert set(names.values()) - {"fmuid"} == order.keys()
    upwards = [
        f"{module} imports {other}"
        for module, others in imports.items()
        for other in others
        if order.get(names[module], len(order)) < order.get(names[other], len(order))
    ]
    assert upwards == []


def test_no_two_modules_have_one_name() -> None:
    names = Counter(module.rpartition(".")[2] for module in FILES)
    assert {name for name, number in names.items() if number > 1} == {"errors"}  # of either package


def called(folder: Path) -> dict[str, set[str]]:
    """C file -> the others in its folder that define functions which it calls."""
    texts = {path.name: re.sub(r"/\*.*?\*/", "", path.read_text(), flags=re.DOTALL) for path in folder.glob("*.c")}
    definition = re.compile(r"^(?!static)\w[\w *]*?\b(\w+)\([^;{}]*\)\s*\{", re.MULTILINE)
    homes = {name: file for file, text in texts.items() for name in definition.findall(text)}
    words = {file: set(re.findall(r"\b\w+(?=\()", text)) & homes.keys() for file, text in texts.items()}
    return {file: {homes[name] for name in names} - {file} for file, names in words.items()}


@pytest.mark.parametrize("folder", ["fmu_build/runtime", "src/fmuid/simulation"])
def test_no_c_file_calls_itself_through_others(folder: str) -> None:
    calls = called(ROOT / folder)
    assert sum(map(len, calls.values())) > len(calls) / 2
    TopologicalSorter(calls).prepare()


def test_a_diagnosis_can_be_read_in_twenty_modules() -> None:
    assert sum(module.startswith("fmuid.diagnosis.") for module in FILES) <= 20
