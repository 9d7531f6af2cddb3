"""README.md, docs/**/*.md and the like: every block is run, in its order, as a reader would.

The blocks of a page share a folder that looks like the repository's root. A block in `python` or `sh` is run; `text` after
it is what it prints (`...` stands for anything); with `<!-- file: NAME -->` before it, a block is the content of that
file; other TOML has to parse. Of commands in a block without a language, which take long, names and options are checked.
`make` is asked only whether it knows the targets. Files that a page takes for granted are in `given/PAGE`.
"""

from __future__ import annotations

import csv
import doctest
import os
import re
import shutil
import subprocess
import sys
import tomllib
from collections.abc import Mapping
from pathlib import Path

import pytest
from typer.main import get_command

import fmuid
from fmu_build import compile_modelica
from fmu_build.errors import ModelicaError
from fmuid.cli.app import app
from tests.conftest import ACTUATOR

ROOT = Path(__file__).parents[2]
PAGES = [
    ROOT / "README.md",
    ROOT / "CONTRIBUTING.md",
    ROOT / "CHANGELOG.md",
    *sorted((ROOT / "docs").rglob("*.md")),
]
NAMES = [str(page.relative_to(ROOT)) for page in PAGES]
SLOW = {
    "cluster",
    "coupled",
    "data",
    "design",
    "drift",
    "effect",
    "go1",
    "modelica",
    "notebook",
    "own-drive",
    "paper",
    "read-diagnosis",
    "report",
    "runaway",
    "sensitivity",
    "three-rigs",
}  # identify, diagnose or build again
BLOCK = re.compile(r"(?:^<!-- file: (\S+) -->\n)?^```(\w*)\n(.*?)^```$", re.MULTILINE | re.DOTALL)
MAKE = f'make() {{ command make --dry-run --directory "{ROOT}" "$@" > /dev/null; }}\n'


def in_turn(page: Path) -> object:
    return pytest.param(page, marks=pytest.mark.slow) if page.stem in SLOW else page


@pytest.fixture
def desk(fmus: Mapping[str, Path], tmp_path: Path) -> Path:
    """A folder with all that a page may name: the repository's folders, FMUs and measurements."""
    if not (ROOT / "campaigns" / "force_feedback" / "measurements.h5").exists():
        rig = [sys.executable, "-m", "benchmarks.virtual_rig", "campaigns/force_feedback"]
        subprocess.run(rig, cwd=ROOT, check=True, capture_output=True)
    for setup in ACTUATOR:  # each is built when it is asked for
        assert fmus[setup].is_file()
    for folder in ("build", "campaigns", "docs", "modelica"):
        (tmp_path / folder).symlink_to(ROOT / folder)
    return tmp_path


@pytest.mark.parametrize("page", [in_turn(page) for page in PAGES], ids=NAMES)
def test_the_blocks_of_a_page(page: Path, desk: Path) -> None:
    given = Path(__file__).parent / "given" / page.stem
    if given.is_dir():
        shutil.copytree(given, desk, dirs_exist_ok=True)
    printed = ""
    for name, language, text in BLOCK.findall(page.read_text()):
        if name:
            (desk / name).write_text(text)
        elif language == "python":
            printed = run([sys.executable, "-W", "error", "-c", text], desk)
        elif language == "sh":
            printed = run(["bash", "-e", "-c", MAKE + text], desk)
        elif language == "toml":
            tomllib.loads(text)
        elif language:
            assert language == "text", f"a block in '{language}' is neither run nor the content of a file"
            options = doctest.ELLIPSIS | doctest.NORMALIZE_WHITESPACE
            assert doctest.OutputChecker().check_output(text, printed, options), printed


def run(command: list[str], folder: Path) -> str:
    scripts = str(Path(sys.executable).parent)
    environment = os.environ | {"PATH": os.pathsep.join([scripts, os.environ["PATH"]])}
    done = subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True, timeout=600)
    assert done.returncode == 0, f"{command[-1]}\n{done.stdout}\n{done.stderr}"
    return done.stdout


@pytest.mark.parametrize("page", PAGES, ids=NAMES)
def test_commands_and_links_in_the_text_exist(page: Path) -> None:
    text = page.read_text()
    commands = get_command(app).commands
    inline = "\n".join(" ".join(code.split()) for code in re.findall(r"`([^`]+)`", BLOCK.sub("", text)))
    inline += "\n" + "\n".join(block for _, language, block in BLOCK.findall(text) if not language)
    if page.name == "errors.md":  # its commands are wrong on purpose; tests/errors runs them
        inline = ""
    for name, rest in re.findall(r"\bfmuid ([a-z-]+)(.*)", inline):
        assert name in commands, f"fmuid {name}"
        known = {o for parameter in commands[name].params for o in parameter.opts + parameter.secondary_opts}
        assert set(re.findall(r"(?<!\S)--[a-z-]+", rest)) <= known, f"fmuid {name}{rest}"
    for link in re.findall(r"\]\(([^)#:]+)[)#]", text):
        assert (page.parent / link).exists(), link
    for link, anchor in re.findall(r"\]\(([^)#:]*)#([^)]+)\)", text):
        assert anchor in anchors(page.parent / link if link else page), f"{link}#{anchor}"


def anchors(page: Path) -> set[str]:
    """Return the anchors of a page's headings, as Python-Markdown makes them."""
    headings = re.findall(r"^#+ (.*)$", BLOCK.sub("", page.read_text()), re.MULTILINE)
    return {re.sub(r"[-\s]+", "-", re.sub(r"[^\w\s-]", "", heading).strip().lower()) for heading in headings}


def test_every_page_is_in_the_menu_of_the_site() -> None:
    settings = (ROOT / "mkdocs.yml").read_text()
    menu = set(re.findall(r": (\S+\.md)$", settings, re.MULTILINE))
    part_of_another = set(re.findall(r"^  (\S+\.md)$", settings, re.MULTILINE))  # exclude_docs
    pages = {str(page.relative_to(ROOT / "docs")) for page in (ROOT / "docs").rglob("*.md")}
    assert menu == pages - part_of_another | {
        "reference/cli.md",
        "reference/python.md",
    }  # docs/hooks.py makes these


@pytest.mark.slow
def test_the_site_is_built_without_a_warning(tmp_path: Path) -> None:
    pytest.importorskip("mkdocs")
    command = [sys.executable, "-m", "mkdocs", "build", "--strict", "--quiet", "--site-dir", str(tmp_path)]
    built = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=600)
    assert built.returncode == 0, built.stderr
    commands = (tmp_path / "reference" / "cli" / "index.html").read_text()
    assert all(f"fmuid {name}" in commands for name in get_command(app).commands)
    python = (tmp_path / "reference" / "python" / "index.html").read_text()
    assert all(f'id="fmuid.{place}.{name}"' in python for name, place in fmuid._PUBLIC.items())


def refusals() -> list[tuple[str, str]]:
    with (ROOT / "docs" / "modelica_refused.csv").open(newline="") as file:
        return [(row["example"], row["message"]) for row in csv.DictReader(file)]


@pytest.mark.parametrize(("example", "message"), refusals())
def test_what_the_guide_says_is_refused(example: str, message: str, tmp_path: Path) -> None:
    file = tmp_path / "M.mo"
    file.write_text(f"model M\n  {example}\nend M;\n")
    with pytest.raises(ModelicaError) as refusal:
        compile_modelica(file, "M")
    assert message in str(refusal.value)
    assert re.match(r"M\.mo:[123]: .*$", str(refusal.value))
