"""Sources of classes: one file, the package that a file lies in, and the directories of libraries.

A class is read on first lookup, so a model only costs what it uses.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from fmu_build.errors import ModelicaError
from fmu_build.front.classes import ClassDef
from fmu_build.front.parser import parse
from fmu_build.syntax import Place

_OWN = Path(__file__).parent / "standard"  # imported by every user, if no library has it


class Library:
    """Top-level classes by name.

    Parameters
    ----------
    file
        The user's file: a separate file, or part of a package on disk.
    roots
        Directories of libraries.
    """

    def __init__(self, file: Path, roots: Sequence[Path]) -> None:
        self.used: dict[Path, None] = {}
        self.roots = [Path(r).resolve() for r in roots]
        self._tops: dict[str, ClassDef | None] = {}
        self._scanned = False
        self.stand_ins: set[str] = set()  # classes taken from our own file
        self.file = file.resolve()
        package = _package_folder(self.file)
        if package is None:
            within, classes = self._read(self.file)
            for found in classes:
                self._add(within, found)
        else:
            self.roots.insert(0, package.parent)
            self._tops[package.name] = self._folder(package)

    def top(self, name: str) -> ClassDef | None:
        """Top-level class of that name; None if missing."""
        if name not in self._tops:
            self._tops[name] = self._find(name)
        return self._tops[name]

    def names(self) -> list[str]:
        """Qualified names of the classes in the user's own file and package."""
        found: list[str] = []

        def visit(definition: ClassDef) -> None:
            found.append(definition.path)
            for element in definition.elements:
                if isinstance(element, ClassDef):
                    visit(element)

        for top in self._tops.values():
            if top is not None:
                visit(top)
        return found

    def _find(self, name: str) -> ClassDef | None:
        for root in self.roots:
            for folder in (root / name, *sorted(root.glob(f"{name} *"), reverse=True)):
                if (folder / "package.mo").is_file():
                    return self._folder(folder)
            if (root / f"{name}.mo").is_file():
                return self._single(root / f"{name}.mo", name)
            package = _package_folder(root / "package.mo")  # the root may be a package itself
            if package is not None and package.name.partition(" ")[0] == name:
                return self._folder(package)
        self._scan()
        if self._tops.get(name):
            return self._tops[name]
        if (_OWN / f"{name}.mo").is_file():
            self.stand_ins.add(name)
            return self._single(_OWN / f"{name}.mo", name)
        return None

    def _scan(self) -> None:
        """Search, once, files whose names may differ from those of their classes."""
        if self._scanned:
            return
        self._scanned = True
        loose = (root for root in self.roots if not (root / "package.mo").is_file())
        for path in (path for root in loose for path in sorted(root.glob("*.mo"))):
            within, classes = self._read(path)
            for found in classes:
                if not within and found.name not in self._tops:
                    self._add("", found)

    def _single(self, path: Path, name: str) -> ClassDef | None:
        _, classes = self._read(path)
        for found in classes:
            found.settle(None, "")
        return next((c for c in classes if c.name == name), None)

    def _add(self, within: str, found: ClassDef) -> None:
        if not within:
            found.settle(None, "")
            self._tops[found.name] = found
            return
        outside: ClassDef | None = None
        for part in within.split("."):
            inner = (self._tops.get(part) if outside is None else outside.member(part)) or ClassDef(
                found.at, part, "package"
            )
            assert isinstance(inner, ClassDef)
            if outside is None:
                self._tops[part] = inner
            elif inner not in outside.elements:
                outside.elements.append(inner)
            inner.settle(outside, "" if outside is None else outside.path)
            outside = inner
        assert outside is not None
        outside.elements.append(found)
        found.settle(outside, outside.path)

    def _read(self, path: Path) -> tuple[str, list[ClassDef]]:
        self.used[path] = None
        try:
            text = path.read_text(encoding="utf-8-sig")
        except UnicodeDecodeError as error:
            raise ModelicaError("the file is not UTF-8", where=path.name) from error
        return parse(text, path.name, whole=path == self.file)

    def _folder(self, folder: Path) -> ClassDef:
        path = folder / "package.mo"
        _, classes = self._read(path)
        if len(classes) != 1:
            raise ModelicaError("a package.mo has one class", where=f"{folder.name}/package.mo")
        (package,) = classes
        package.settle(None, "")
        missing: set[str] = set()

        def load(outside: ClassDef, name: str) -> ClassDef | None:
            if name in missing:
                return None
            if (folder / name / "package.mo").is_file():
                found = self._folder(folder / name)
            elif (folder / f"{name}.mo").is_file() and name != "package":
                classes = self._read(folder / f"{name}.mo")[1]
                if [c.name for c in classes] != [name]:
                    raise ModelicaError(f"the file does not have the class '{name}' alone", where=f"{name}.mo")
                (found,) = classes
            else:
                missing.add(name)
                return None
            outside.elements.append(found)
            found.settle(outside, outside.path)
            return found

        package.loader = load
        return package


def _package_folder(file: Path) -> Path | None:
    """Folder of the outermost package that a file lies in; None for a separate file."""
    folder = file.parent
    if not (folder / "package.mo").is_file():
        return None
    while (folder.parent / "package.mo").is_file():
        folder = folder.parent
    return folder


def place_of(path: Path) -> Place:
    """Place of a file as a whole."""
    return Place(path.name, 1)
