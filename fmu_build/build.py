"""Modelica class to FMU in one step, cached by content."""

from __future__ import annotations

import gc
import hashlib
import json
import logging
import os
import re
import shutil
import subprocess
import tempfile
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import cache
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from fmu_build.errors import BuildError, ModelicaError
from fmu_build.front.standard_folders import standard_folders
from fmu_build.sources import source_files

if TYPE_CHECKING:
    from fmu_build.flat_model import FlatModel

Compiler = Literal["own", "omc"]


@contextmanager
def _without_collections() -> Iterator[None]:
    """Leave out Python's search for circular garbage: there is hardly any, and it takes a tenth of the time."""
    enabled = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if enabled:
            gc.enable()


@_without_collections()
def build(
    file: Path | str,
    class_name: str,
    out: Path | str,
    fmi: str = "2",
    *,
    compiler: str = "own",
    roots: Sequence[Path | str] = (),
) -> Path:
    """Build the FMU of a Modelica class.

    An existing FMU is kept if nothing it depends on has changed: the Modelica files that were read and the names
    of those next to them, this package, the version of CasADi, and the options.

    Parameters
    ----------
    file
        Modelica file with the class, or any file or the folder of its package.
    class_name
        Qualified class name.
    out
        Folder for ``<last part of the class name>.fmu``.
    fmi
        Version of FMI, "2" or "3".
    compiler
        "own" (built in) or "omc" (OpenModelica, if it is on the PATH).
    roots
        Directories of further Modelica libraries.

    Returns
    -------
    Path
        The FMU.

    Raises
    ------
    ModelicaError
        The source is wrong or outside the supported subset.
    BuildError
        An option is invalid, or a compiler is missing or fails.
    """
    file, out, folders = Path(file), Path(out), [Path(r) for r in roots]
    if fmi not in ("2", "3"):
        raise BuildError(f"FMI version {fmi!r}", fix="choose 2 or 3")
    if file.is_dir():
        file /= "package.mo"
    if not file.is_file():
        raise ModelicaError("no such Modelica file", where=file)
    if compiler == "own":
        check_tools()
    target = out / f"{class_name.rpartition('.')[2]}.fmu"
    stamp = target.with_suffix(".stamp")
    options = _options(class_name, fmi, compiler, file, folders)
    if _is_current(stamp, target, options):
        return target
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        what = f"cannot be a folder ({error.strerror or error})"
        raise BuildError(what, where=out, fix="choose a folder that can be written") from None
    if compiler == "own":
        from fmu_build.compiler import compile_flat
        from fmu_build.packaging import package

        flat = load(file, class_name, folders)
        read, libraries = flat.files, flat.libraries
        model = compile_flat(flat)
        for warning in model.warnings:
            logging.getLogger(__name__).warning("warning: %s: %s", class_name, warning)
        built = package(model, target, fmi=2 if fmi == "2" else 3)
    elif compiler == "omc":
        read, libraries = source_files(file, folders), ()
        built = _openmodelica(file, class_name, target, fmi, folders)
    else:
        raise BuildError(f"no Modelica compiler {compiler!r}", fix="choose own or omc")
    partial = stamp.with_name(f".{stamp.name}.{os.getpid()}")
    record: dict[str, Any] = {"options": options, "fmu": _digest(built), "libraries": libraries}
    record |= _sources(read, folders)
    partial.write_text(json.dumps(record))
    partial.replace(stamp)
    return built


def libraries_of(fmu: Path) -> tuple[tuple[str, str], ...]:
    """Return names and versions of the libraries from which `build` made an FMU."""
    stamp = fmu.with_suffix(".stamp")
    record = json.loads(stamp.read_text()) if stamp.is_file() else {}
    return tuple((name, version) for name, version in record.get("libraries", ()))


_TOOLS = ("casadi",)


def check_tools() -> None:
    """Raise a `BuildError` that names the packages to install if some that the export needs are missing."""
    missing = [name for name in _TOOLS if find_spec(name) is None]
    if missing:
        raise BuildError(f"the Modelica export needs {', '.join(missing)}", fix="pip install 'fmuid[build]'")


def _digest(path: Path) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest()


@cache
def _tools() -> list[str]:
    """Return the digests of this package's files, which a process loads once."""
    folder = Path(__file__).parent
    return [_digest(p) for p in sorted(folder.rglob("*")) if p.suffix in (".py", ".c", ".h", ".mo")]


def built_by() -> str:
    """Return a digest of what builds FMUs: this package with its runtime, libraries, compiler and flags."""
    from importlib import metadata  # slow to import, and every command imports this module

    flags = [os.environ.get(name, "") for name in ("CC", "FMU_BUILD_CFLAGS")]
    versions = [metadata.version(name) for name in _TOOLS if find_spec(name)]
    return hashlib.sha256(json.dumps([flags, versions, _tools()]).encode()).hexdigest()


def _options(class_name: str, fmi: str, compiler: str, file: Path, roots: Sequence[Path]) -> str:
    """Digest of everything that the FMU depends on in addition to the Modelica sources."""
    places = [str(p.resolve()) for p in (file, *roots, *standard_folders())]
    return hashlib.sha256(json.dumps([class_name, fmi, compiler, places, built_by()]).encode()).hexdigest()


def _is_current(stamp: Path, target: Path, options: str) -> bool:
    """Whether the FMU exists as it was made, and its sources have not changed since."""
    if not (target.is_file() and stamp.is_file()):
        return False
    try:
        record = json.loads(stamp.read_text())
        made = record["options"] == options and record["fmu"] == _digest(target)
        return made and _unchanged(record)
    except (ValueError, TypeError, KeyError, AttributeError):
        return False


_Sources = Mapping[str, Mapping[str, Any]]


def _sources(files: Iterable[Path], roots: Iterable[Path]) -> _Sources:
    """Digests of the files that were read, and what is next to them, because a name may refer to a new file."""
    digests = {str(p.resolve()): _digest(p) for p in files}
    folders = {*(Path(p).parent for p in digests), *(r.resolve() for r in roots)}
    return {"files": digests, "beside": {str(folder): _names(folder) for folder in sorted(folders)}}


def _unchanged(sources: _Sources) -> bool:
    same = all(Path(p).is_file() and _digest(Path(p)) == digest for p, digest in sources["files"].items())
    return same and all(_names(Path(folder)) == names for folder, names in sources["beside"].items())


_MOST_KEPT = 4
_kept: dict[tuple[object, ...], tuple[FlatModel, _Sources]] = {}


def load(file: Path, class_name: str, roots: Sequence[Path] = ()) -> FlatModel:
    """Flatten a Modelica class; see `fmu_build.front.flatten.load`. The latest are kept while no file changes."""
    check_tools()
    from fmu_build.front.flatten import load as load_

    key = Path(file).resolve(), class_name, *(Path(r).resolve() for r in roots), *standard_folders()
    if key in _kept and _unchanged(_kept[key][1]):
        return _kept[key][0]
    flat = load_(file, class_name, roots)
    _kept[key] = flat, _sources(flat.files, map(Path, roots))
    while len(_kept) > _MOST_KEPT:
        del _kept[next(iter(_kept))]
    return flat


def _names(folder: Path) -> list[str]:
    if not folder.is_dir():
        return []
    return sorted(p.name for p in folder.iterdir() if p.suffix == ".mo" or (p / "package.mo").is_file())


def _openmodelica(file: Path, class_name: str, target: Path, fmi: str, roots: Sequence[Path]) -> Path:
    """Build with OpenModelica's own FMU export."""
    omc = shutil.which("omc")
    if omc is None:
        raise BuildError("OpenModelica's omc is not on the PATH", fix="install it or leave out --compiler omc")
    inside = {p.parent for p in source_files(file, roots) if p.name == "package.mo"}  # loaded with its package
    sources = [
        str(p)
        for p in source_files(file, roots)
        if (p.parent.parent if p.name == "package.mo" else p.parent) not in inside
    ]
    with tempfile.TemporaryDirectory() as folder:
        loads = "".join(f"loadFile({json.dumps(p)});\n" for p in sources)
        script = f'{loads}buildModelFMU({class_name}, version="{fmi}.0", fmuType="me_cs");\ngetErrorString();\n'
        (Path(folder) / "build.mos").write_text(script)
        run = subprocess.run([omc, "build.mos"], cwd=folder, capture_output=True, text=True, check=False)
        made = sorted(Path(folder).glob("*.fmu"))
        if not made:
            printed = f"{run.stdout}\n{run.stderr}"
            error = re.search(r"Error: .*", printed) or re.search(r"\S.*", printed)
            raise BuildError(f"omc built no FMU: {error.group() if error else 'no message'}", where=class_name)
        shutil.move(made[0], target)
    return target
