"""Classes as written: elements, modifications, sections."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

from fmu_build.syntax import Expression, Place, Reference


@dataclass(frozen=True, slots=True)
class Modification:
    """``(arguments) = value``."""

    at: Place
    arguments: tuple[Argument | Redeclaration, ...] = ()
    value: Expression | None = None
    broken: bool = False  # ``= break``


@dataclass(frozen=True, slots=True)
class Argument:
    """``each final name modification``; a dotted name is written as nested arguments."""

    at: Place
    name: str
    modification: Modification
    each: bool = False
    final: bool = False


@dataclass(frozen=True, slots=True)
class Redeclaration:
    """``redeclare element`` or ``replaceable element`` inside a modification."""

    at: Place
    element: ComponentDef | ClassDef
    each: bool = False
    final: bool = False

    @property
    def name(self) -> str:
        """Name of the redeclared element."""
        return self.element.name


@dataclass(frozen=True, slots=True)
class Constraint:
    """``constrainedby type modification``."""

    type: Reference
    modification: Modification


@dataclass(frozen=True, slots=True)
class ComponentDef:
    """One declared component."""

    at: Place
    name: str
    type: Reference
    prefixes: frozenset[str]  # flow stream parameter constant discrete input output
    subscripts: tuple[Expression, ...]
    modification: Modification
    condition: Expression | None
    description: str
    annotation: Source | None
    redeclare: bool = False
    final: bool = False
    inner: bool = False
    outer: bool = False
    replaceable: bool = False
    constraint: Constraint | None = None
    protected: bool = False


@dataclass(frozen=True, slots=True)
class Extends:
    """``extends type modification``."""

    at: Place
    type: Reference
    modification: Modification
    protected: bool = False
    of_redeclared: bool = False  # in ``redeclare model extends``


@dataclass(frozen=True, slots=True)
class Import:
    """An import: ``name`` is visible as `alias`; an alias of ``*`` brings in the whole package."""

    at: Place
    name: str
    alias: str


@dataclass(frozen=True, slots=True)
class Short:
    """``= prefix type[subscripts] modification`` of a short class."""

    type: Reference
    prefixes: frozenset[str]
    subscripts: tuple[Expression, ...]
    modification: Modification


@dataclass(frozen=True, slots=True)
class External:
    """``external "language" output = name(arguments)``."""

    at: Place
    language: str
    name: str
    output: Reference | None
    arguments: tuple[Expression, ...] | None


@dataclass(frozen=True, slots=True)
class Section:
    """An equation or algorithm section."""

    at: Place
    kind: str  # "equation" or "algorithm"
    initial: bool
    items: tuple[Any, ...]


_BODY = frozenset(("description", "annotation", "elements", "imports", "sections", "external"))


@dataclass(slots=True, eq=False)
class ClassDef:
    """A class as written. Filled by the parser and not changed afterwards (except for files of a package).

    Its body may be parsed only on first use (see `postpone`).
    """

    at: Place
    name: str
    kind: str
    partial: bool = False
    encapsulated: bool = False
    redeclare: bool = False
    final: bool = False
    inner: bool = False
    outer: bool = False
    replaceable: bool = False
    protected: bool = False
    impure: bool = False
    constraint: Constraint | None = None
    short: Short | None = None
    enumeration: tuple[tuple[str, str], ...] | None = None
    extended: Modification | None = None  # of ``redeclare class extends``
    description: str = ""
    annotation: Source | None = None
    elements: list[ComponentDef | ClassDef | Extends] = field(default_factory=list)
    imports: list[Import] = field(default_factory=list)
    sections: list[Section] = field(default_factory=list)
    external: External | None = None
    outside: ClassDef | None = None  # the class it is written in
    path: str = ""  # qualified name
    loader: Any = None  # finds members of a package that have their own files
    folder: str = ""  # that of such a package
    _parse: Callable[[ClassDef], None] | None = None  # the remaining parsing

    def postpone(self, parse: Callable[[ClassDef], None]) -> None:
        """Leave the body to a function that fills it in when one of its parts is first requested."""
        for name in _BODY:
            delattr(self, name)
        self._parse = parse

    def __getattr__(self, name: str) -> Any:
        """Fill in the body, whose parts are not attributes before."""
        if name not in _BODY or self._parse is None:
            raise AttributeError(name)
        parse, self._parse = self._parse, None
        self.description, self.annotation, self.external = "", None, None
        self.elements, self.imports, self.sections = [], [], []
        parse(self)
        for element in self.elements:
            if isinstance(element, ClassDef):
                element.settle(self, self.path)
        return getattr(self, name)

    def settle(self, outside: ClassDef | None, prefix: str) -> None:
        """Set the place of a class and of those inside it."""
        self.outside = outside
        self.path = f"{prefix}.{self.name}" if prefix else self.name
        if self._parse is None:
            for element in self.elements:
                if isinstance(element, ClassDef):
                    element.settle(self, self.path)

    def member(self, name: str) -> ClassDef | ComponentDef | None:
        """Own element of that name, from its own file if necessary."""
        for element in self.elements:
            if not isinstance(element, Extends) and element.name == name:
                return element
        if self.loader is not None:
            return self.loader(self, name)  # type: ignore[no-any-return]
        return None


@dataclass(frozen=True, slots=True)
class Source:
    """A piece of source that is parsed on request (annotations)."""

    file: str
    text: str
    start: int
    stop: int
