"""Sources of classes: one file, the package that a file lies in, and the directories of libraries.

A class is read on first lookup, so a model only costs what it uses.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path

from fmu_build.errors import ModelicaError
from fmu_build.front.classes import Argument, ClassDef, Redeclaration
from fmu_build.front.parser import KINDS, annotation, parse
from fmu_build.front.standard_folders import standard_folders
from fmu_build.syntax import Literal, Place

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
        self.warnings: list[str] = []
        self.roots = [Path(r).resolve() for r in roots]
        self._standard = standard_folders()
        self._tops: dict[str, ClassDef | None] = {}
        self._unnamed: dict[Path, str] | None = None  # texts of files whose names may differ from their classes
        self.stand_ins: set[str] = set()  # classes taken from our own file
        self.file = file.resolve()
        package = _package_folder(self.file)
        if package is None:
            within, classes = self._read(self.file)
            for definition in classes:
                self._add(within, definition)
        else:
            self.roots.insert(0, package.parent)
            self._tops[package.name] = self._folder(package)

    def top(self, name: str) -> ClassDef | None:
        """Top-level class of that name; None if missing."""
        if name not in self._tops:
            self._tops[name] = self._find(name)
        return self._tops[name]

    def resource(self, uri: str) -> str:
        """Path of the file that a URI of Modelica or a path from the user's file names."""
        path = self.file.parent / uri
        if uri.startswith("modelica://"):
            package, _, rest = uri.removeprefix("modelica://").partition("/")
            first, *inner = package.split(".")
            top = self.top(first)
            folder = top.folder if top is not None else ""
            path = Path(folder or self.file.parent, *inner, rest)
        if path.is_file():
            self.used[path] = None
        return str(path)

    def names(self) -> list[str]:
        """Qualified names of the classes in the user's own file and package."""
        names: list[str] = []

        def visit(definition: ClassDef) -> None:
            names.append(definition.path)
            for element in definition.elements:
                if isinstance(element, ClassDef):
                    visit(element)

        for top in self._tops.values():
            if top is not None:
                visit(top)
        return names

    def _find(self, name: str) -> ClassDef | None:
        for root in (*self.roots, *self._standard):
            folders = self._versions(root, name)
            if folders:
                return self._folder(folders[0])
            if (root / f"{name}.mo").is_file():
                return self._single(root / f"{name}.mo", name)
            package = _package_folder(root / "package.mo")  # the root may be a package itself
            if package is not None and package.name.partition(" ")[0] == name:
                return self._folder(package)
        self._scan(name)
        if self._tops.get(name):
            return self._tops[name]
        if (_OWN / f"{name}.mo").is_file():
            self.stand_ins.add(name)
            return self._single(_OWN / f"{name}.mo", name)
        return None

    def _versions(self, root: Path, name: str) -> list[Path]:
        """Folders of a library in a directory: the version that the model uses, then the newest first."""
        folders = [root / name, *sorted(root.glob(f"{name} *"), reverse=True)]
        folders = [folder for folder in folders if (folder / "package.mo").is_file()]
        if len(folders) < 2:
            return folders
        wanted = f"{name} {self._used_version(name) or ''}"
        return sorted(folders, key=lambda folder: not folder.name.startswith(wanted))

    def _used_version(self, name: str) -> str | None:
        """Version of a library that the model's ``uses`` annotation names."""
        for top in list(self._tops.values()):
            for used in _arguments(top, "uses"):
                if used.name == name:
                    return _text(used, "version")
        return None

    def versions(self) -> dict[str, str]:
        """Versions of the libraries that the model uses, by name."""
        versions: dict[str, str] = {}
        for name, top in sorted(self._tops.items()):
            used = top is not None and top.loader is not None and name not in self.stand_ins
            if top is None or not used or self.file.is_relative_to(Path(top.folder)):
                continue
            version = _string(next((a for a in annotation(top.annotation) if a.name == "version"), None))
            if version is not None:
                versions[name] = version
        return versions

    def _scan(self, name: str) -> None:
        """Read the files in the roots that may define a class of another name than theirs."""
        if self._unnamed is None:
            roots = [root for root in self.roots if not (root / "package.mo").is_file()]
            self._unnamed = {path: self._text(path) for root in roots for path in sorted(root.glob("*.mo"))}
        defines = re.compile(
            rf"\b(?:{'|'.join(KINDS)})(?:\s|//[^\n]*|/\*.*?\*/)+{re.escape(name)}(?!\w)", re.DOTALL
        )
        for path in [path for path, text in self._unnamed.items() if defines.search(text)]:
            within, classes = self._parsed(path, self._unnamed.pop(path))
            for definition in classes:
                if not within and definition.name not in self._tops:
                    self._add("", definition)

    def _single(self, path: Path, name: str) -> ClassDef | None:
        _, classes = self._read(path)
        for definition in classes:
            definition.settle(None, "")
        return next((c for c in classes if c.name == name), None)

    def _add(self, within: str, definition: ClassDef) -> None:
        if not within:
            definition.settle(None, "")
            self._tops[definition.name] = definition
            return
        outside: ClassDef | None = None
        for part in within.split("."):
            inner = (self._tops.get(part) if outside is None else outside.member(part)) or ClassDef(
                definition.at, part, "package"
            )
            assert isinstance(inner, ClassDef)
            if outside is None:
                self._tops[part] = inner
            elif inner not in outside.elements:
                outside.elements.append(inner)
            inner.settle(outside, "" if outside is None else outside.path)
            outside = inner
        assert outside is not None
        outside.elements.append(definition)
        definition.settle(outside, outside.path)

    def _text(self, path: Path) -> str:
        self.used[path] = None
        try:
            return path.read_text(encoding="utf-8-sig")
        except UnicodeDecodeError:
            self.warnings.append(f"{path.name}: not UTF-8, so it is read as Latin-1")
            return path.read_text(encoding="latin-1")

    def _parsed(self, path: Path, text: str) -> tuple[str, list[ClassDef]]:
        return parse(text, path.name, whole=path == self.file)

    def _read(self, path: Path) -> tuple[str, list[ClassDef]]:
        return self._parsed(path, self._text(path))

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
                definition = self._folder(folder / name)
            elif (folder / f"{name}.mo").is_file() and name != "package":
                classes = self._read(folder / f"{name}.mo")[1]
                if [c.name for c in classes] != [name]:
                    raise ModelicaError(f"the file does not have the class '{name}' alone", where=f"{name}.mo")
                (definition,) = classes
            else:
                missing.add(name)
                return None
            outside.elements.append(definition)
            definition.settle(outside, outside.path)
            return definition

        package.loader = load
        package.folder = str(folder)
        return package


def _package_folder(file: Path) -> Path | None:
    """Folder of the outermost package that a file lies in; None for a separate file."""
    folder = file.parent
    if not (folder / "package.mo").is_file():
        return None
    while (folder.parent / "package.mo").is_file():
        folder = folder.parent
    return folder


def _arguments(top: ClassDef | None, name: str) -> list[Argument]:
    """Arguments of a part of a class's annotation."""
    for part in annotation(top.annotation) if top is not None else ():
        if isinstance(part, Argument) and part.name == name:
            return [a for a in part.modification.arguments if isinstance(a, Argument)]
    return []


def _text(argument: Argument, name: str) -> str | None:
    """Text of an argument's argument, as of ``Modelica(version = "4.0.0")``."""
    return _string(next((a for a in argument.modification.arguments if a.name == name), None))


def _string(argument: Argument | Redeclaration | None) -> str | None:
    value = argument.modification.value if isinstance(argument, Argument) else None
    return value.value if isinstance(value, Literal) and isinstance(value.value, str) else None


def place_of(path: Path) -> Place:
    """Place of a file as a whole."""
    return Place(path.name, 1)
