"""Parser of Modelica 3.6 source, by recursive descent.

Annotations are skipped by their parentheses and parsed on request, because they are most of a library's text.
"""

from __future__ import annotations

import re
from bisect import bisect_right
from typing import Any, NoReturn

from fmu_build.errors import ModelicaError
from fmu_build.front.classes import (
    Argument,
    ClassDef,
    ComponentDef,
    Constraint,
    Extends,
    External,
    Import,
    Modification,
    Redeclaration,
    Section,
    Short,
    Source,
)
from fmu_build.syntax import (
    All,
    ArrayOf,
    Assert,
    Assign,
    AssignMany,
    Binary,
    Break,
    Call,
    Comprehension,
    Connect,
    End,
    Expression,
    ForStatement,
    If,
    IfStatement,
    Literal,
    Matrix,
    Part,
    PartialCall,
    Place,
    Range,
    Reference,
    Reinit,
    Return,
    SourceEquation,
    Subscripted,
    Terminate,
    TupleOf,
    Unary,
    WhenStatement,
    WhileStatement,
)

_STRING = r'"[^"\\]*(?:\\.[^"\\]*)*"'
_QUOTED = r"'(?:\\.|[^'\\])*'"
_COMMENT = r"//[^\n]*|/\*.*?\*/"
_TOKEN = re.compile(  # or a character that begins none; empty at the end
    rf"(?>(?:\s+|{_COMMENT})*)([^\W\d]\w*|{_QUOTED}|{_STRING}|\d+(?:\.\d*)?(?:[eE][-+]?\d+)?|\.\d+(?:[eE][-+]?\d+)?"
    r"|:=|<=|>=|<>|==|/\*|\.[-+*/^]|[-+*/^()\[\]{},;:=<>.]|\S|\Z)",
    re.DOTALL,
)
_SINGLE = re.compile(r"[\w\-+*/^()\[\]{},;:=<>.]")
_ENDLESS = {'"': "this string does not end", "/*": "this comment does not end"}
_BRACKETS = re.compile(rf"{_STRING}|{_QUOTED}|{_COMMENT}|[()]", re.DOTALL)
_ESCAPE = re.compile(r"\\(.)", re.DOTALL)
_ESCAPED = {"n": "\n", "t": "\t", "r": "\r", "a": "\a", "b": "\b", "f": "\f", "v": "\v"}
_NAME = re.compile(rf"[^\W\d]\w*\Z|{_QUOTED}\Z")

_KEYWORDS = frozenset(
    re.findall(
        r"\w+",
        """algorithm and annotation block break class connect connector constant constrainedby der discrete each
        else elseif elsewhen encapsulated end enumeration equation expandable extends external false final flow
        for function if import impure in initial inner input loop model not operator or outer output package
        parameter partial protected public pure record redeclare replaceable return stream then true type when
        while within""",
    )
)
KINDS = frozenset(["class", "model", "record", "block", "connector", "type", "package", "function", "operator"])
_CLASS_START = KINDS | {"partial", "encapsulated", "expandable", "pure", "impure"}
_COMPONENT_PREFIXES = frozenset(["flow", "stream", "parameter", "constant", "discrete", "input", "output"])
_SECTION_START = frozenset(
    ["public", "protected", "equation", "algorithm", "initial", "external", "annotation", "end"]
)
_RELATIONS = frozenset(("<", "<=", ">", ">=", "==", "<>"))
_SUMS = frozenset(("+", "-", ".+", ".-"))
_PRODUCTS = frozenset(("*", "/", ".*", "./"))
_FUNCTIONS = frozenset(("der", "initial", "pure"))


def parse(text: str, file: str, *, whole: bool = True) -> tuple[str, list[ClassDef]]:
    """Parse a file.

    Parameters
    ----------
    text
        Its text.
    file
        Its name, for messages.
    whole
        Whether the bodies of inner classes are parsed as well, or only on first use: a model uses few classes of a
        library's file.

    Returns
    -------
    tuple
        Name after ``within`` ("" if none), and the classes.

    Raises
    ------
    ModelicaError
        The source has an error; the message names file and line.
    """
    parser = _Parser(text, file)
    parser.whole = whole
    return parser.stored_definition()


def annotation(source: Source | None) -> tuple[Argument | Redeclaration, ...]:
    """Return the arguments of an annotation."""
    if source is None:
        return ()
    return _Parser(source.text, source.file, source.start, source.stop).class_modification()


def expression(text: str, file: str = "(expression)") -> Expression:
    """Parse an expression."""
    parser = _Parser(text, file)
    out = parser.expression()
    if parser.i < parser.last:
        parser.fail()
    return out


def unescaped(text: str) -> str:
    """Return the value of a string as written between its quotes."""
    return _ESCAPE.sub(lambda m: _ESCAPED.get(m.group(1), m.group(1)), text) if "\\" in text else text


class _Parser:
    def __init__(self, text: str, file: str, start: int = 0, stop: int | None = None) -> None:
        self.text = text
        self.file = file
        self.newlines = [m.start() for m in re.finditer("\n", text)]
        self.tokens: list[str] = []
        self.starts: list[int] = []
        self.stops: dict[int, int] = {}  # ends of annotations
        self.i = 0
        self.whole = True
        self._depth = 0
        self._places: dict[int, Place] = {}
        self._tokenise(start, len(text) if stop is None else stop)
        self.last = len(self.tokens) - 1

    # ---- tokens

    def _tokenise(self, start: int, stop: int) -> None:
        """Split the text into tokens, leaving out the arguments of annotations."""
        position: int | None = start
        while position is not None:
            position = self._tokenise_up_to_annotation(position, stop)
        wrong = {t for t in set(self.tokens) if t == "/*" or (len(t) == 1 and not _SINGLE.match(t))}
        if wrong:
            number = next(k for k, token in enumerate(self.tokens) if token in wrong)
            what = _ENDLESS.get(self.tokens[number], f"unexpected {self.tokens[number]!r}")
            raise ModelicaError(what, where=Place(self.file, self._line(self.starts[number])))
        self.starts[-1] = max(stop - 1, 0)

    def _tokenise_up_to_annotation(self, position: int, stop: int) -> int | None:
        add_token, add_start = self.tokens.append, self.starts.append
        for match in _TOKEN.finditer(self.text, position, stop):
            token = match[1]
            add_token(token)
            add_start(match.start(1))
            if token == "annotation":
                return self._skip(match.end(), len(self.tokens) - 1)
            if not token:
                break
        return None

    def _skip(self, position: int, number: int) -> int:
        depth = 0
        for match in _BRACKETS.finditer(self.text, position):
            token = match.group()
            if token == "(":
                depth += 1
            elif token == ")":
                depth -= 1
                if depth == 0:
                    self.stops[number] = match.end()
                    return match.end()
        raise ModelicaError("this annotation does not end", where=Place(self.file, self._line(position)))

    def _line(self, position: int) -> int:
        return bisect_right(self.newlines, position - 1) + 1 if position else 1

    def place(self, number: int | None = None) -> Place:
        position = self.starts[self.i if number is None else number]
        line = bisect_right(self.newlines, position) + 1
        place = self._places.get(line)
        if place is None:
            place = self._places[line] = Place(self.file, line)
        return place

    @property
    def token(self) -> str:
        return self.tokens[self.i]

    def accept(self, token: str) -> bool:
        if self.tokens[self.i] == token:
            self.i += 1
            return True
        return False

    def expect(self, token: str) -> None:
        if self.tokens[self.i] != token:
            # a missing token is reported after the previous one
            at = self.place(max(self.i - 1, 0)) if token in (";", ")", "]", "}") else self.place()
            instead = f"'{self.token}'" if self.token else "the end of the file"
            raise ModelicaError(f"'{token}' is expected here, not {instead[:40]}", where=at)
        self.i += 1

    def fail(self, what: str | None = None) -> NoReturn:
        if what is None:
            what = f"unexpected '{self.token[:40]}'" if self.token else "unexpected end of the file"
        raise ModelicaError(what, where=self.place())

    def ident(self) -> str:
        token = self.tokens[self.i]
        if token in _KEYWORDS or not _NAME.match(token):
            self.fail(f"a name is expected here, not '{token[:40]}'" if token else None)
        self.i += 1
        return token

    # ---- classes

    def stored_definition(self) -> tuple[str, list[ClassDef]]:
        within = ""
        if self.text.startswith("\ufeff"):
            self.fail("byte order marks are not supported")
        if self.accept("within"):
            if self.token != ";":
                within = self.dotted()
            self.expect(";")
        classes = []
        while self.token:
            final = self.accept("final")
            definition = self.class_definition()
            definition.final = final
            self.expect(";")
            classes.append(definition)
        return within, classes

    def dotted(self) -> str:
        name = self.ident()
        while self.token == "." and self.tokens[self.i + 1] not in ("*", "{"):
            self.i += 1
            name = f"{name}.{self.ident()}"
        return name

    def type_name(self) -> Reference:
        at = self.place()
        rooted = self.accept(".")
        return Reference(at, tuple(Part(p) for p in self.dotted().split(".")), rooted)

    def class_definition(self) -> ClassDef:
        at = self.place()
        encapsulated = self.accept("encapsulated")
        partial = self.accept("partial")
        prefix = ""
        impure = False
        while self.token in ("operator", "expandable", "pure", "impure"):
            word = self.token
            if word == "operator" and self.tokens[self.i + 1] not in ("record", "function"):
                break
            self.i += 1
            impure = impure or word == "impure"
            prefix = word if word in ("operator", "expandable") else prefix
        kind = self.token
        if kind not in KINDS:
            self.fail(f"a class is expected here, not '{kind[:40]}'" if kind else None)
        self.i += 1
        if prefix:
            kind = f"{prefix} {kind}"
        out = ClassDef(at, "", kind, partial, encapsulated, impure=impure)
        if self.accept("extends"):
            out.name = self.ident()
            out.extended = self.modification() if self.token == "(" else Modification(at)
            self.body(out)
            return out
        out.name = self.ident()
        if not self.accept("="):
            self.body(out)
            return out
        if self.accept("enumeration"):
            self.enumeration(out)
        elif self.token == "der" and self.tokens[self.i + 1] == "(":
            self.fail("functions defined as derivatives of others are not supported")
        else:
            prefixes = []
            while self.token in ("input", "output", "flow", "stream"):
                prefixes.append(self.token)
                self.i += 1
            name = self.type_name()
            subscripts = self.subscripts() if self.token == "[" else ()
            modification = self.modification() if self.token == "(" else Modification(at)
            out.short = Short(name, frozenset(prefixes), subscripts, modification)
        out.description, out.annotation = self.comment()
        return out

    def enumeration(self, out: ClassDef) -> None:
        self.expect("(")
        literals: list[tuple[str, str]] = []
        if not self.accept(":"):
            while self.token != ")":
                name = self.ident()
                literals.append((name, self.comment()[0]))
                if not self.accept(","):
                    break
        self.expect(")")
        out.enumeration = tuple(literals)

    def string_comment(self) -> str:
        if not self.token.startswith('"'):
            return ""
        text = self.token[1:-1]
        self.i += 1
        while self.accept("+"):
            text += self.token[1:-1]
            self.i += 1
        return unescaped(text)

    def comment(self) -> tuple[str, Source | None]:
        text = self.string_comment()
        return text, self.annotation() if self.token == "annotation" else None

    def annotation(self) -> Source:
        number = self.i
        self.i += 1
        start = self.starts[number] + len("annotation")
        return Source(self.file, self.text, start, self.stops[number])

    def body(self, out: ClassDef) -> None:
        end = None if self.whole or not self._depth else self._end(out.name)
        if end is None:
            self._depth += 1
            self._body(out)
            self._depth -= 1
            return
        begin, self.i = self.i, end

        def parse(out: ClassDef) -> None:
            here, self.i = self.i, begin
            self._depth += 1
            self._body(out)
            self._depth -= 1
            self.i = here

        out.postpone(parse)

    def _end(self, name: str) -> int | None:
        """Return the token after a class; None if a class inside it has the same name, or it does not end."""
        tokens = self.tokens
        at = self.i
        try:
            while True:
                at = tokens.index(name, at + 1)
                if tokens[at - 1] in KINDS:
                    return None
                if tokens[at - 1] == "end":
                    return at + 1
        except ValueError:
            return None

    def _body(self, out: ClassDef) -> None:
        out.description = self.string_comment()
        protected = False
        while True:
            token = self.token
            if token == "end":
                break
            if token in ("public", "protected"):
                self.i += 1
                protected = token == "protected"
            elif token == "initial" or token in ("equation", "algorithm"):
                self.section(out)
            elif token == "external":
                self.external(out)
            elif token == "annotation":
                out.annotation = self.annotation()
                self.expect(";")
            elif not token:
                raise ModelicaError(f"'{out.name}' does not end", where=out.at)
            else:
                self.element(out, protected)
        self.i += 1
        at = self.place()
        name = self.ident()
        if name != out.name:
            raise ModelicaError(f"'end {name}' ends '{out.name}'", where=at)

    def element(self, out: ClassDef, protected: bool) -> None:
        if self.token == "import":
            self.import_clause(out)
        elif self.token == "extends":
            at = self.place()
            self.i += 1
            name = self.type_name()
            modification = self.modification() if self.token == "(" else Modification(at)
            if self.token == "annotation":
                self.annotation()
            out.elements.append(Extends(at, name, modification, protected))
        else:
            for element in self.declaration(protected):
                if isinstance(element, ClassDef):
                    element.outside = out
                out.elements.append(element)
        self.expect(";")

    def import_clause(self, out: ClassDef) -> None:
        at = self.place()
        self.i += 1
        name = self.dotted()
        if self.accept("="):
            out.imports.append(Import(at, self.dotted(), name))
        elif self.accept("."):
            if self.accept("*"):
                out.imports.append(Import(at, name, "*"))
            else:
                self.expect("{")
                while True:
                    member = self.ident()
                    out.imports.append(Import(at, f"{name}.{member}", member))
                    if not self.accept(","):
                        break
                self.expect("}")
        elif self.accept(".*"):
            out.imports.append(Import(at, name, "*"))
        else:
            out.imports.append(Import(at, name, name.rpartition(".")[2]))
        self.comment()

    def declaration(self, protected: bool = False) -> list[ComponentDef | ClassDef]:
        """Parse a class or a component clause with the prefixes of an element."""
        flags = {}
        for flag in ("redeclare", "final", "inner", "outer", "replaceable"):
            flags[flag] = self.accept(flag)
        token = self.token
        if token in _CLASS_START and not (token == "operator" and self.tokens[self.i + 1] == "."):
            definition = self.class_definition()
            for flag, value in flags.items():
                setattr(definition, flag, value)
            definition.protected = protected
            if self.token == "constrainedby":
                definition.constraint = self.constraint()
                description, source = self.comment()
                definition.description = definition.description or description
                definition.annotation = definition.annotation or source
            return [definition]
        return list(self.component_clause(flags, protected))

    def constraint(self) -> Constraint:
        self.expect("constrainedby")
        at = self.place()
        name = self.type_name()
        return Constraint(name, self.modification() if self.token == "(" else Modification(at))

    def component_clause(
        self, flags: dict[str, bool], protected: bool, single: bool = False
    ) -> list[ComponentDef]:
        prefixes = []
        while self.token in _COMPONENT_PREFIXES:
            prefixes.append(self.token)
            self.i += 1
        name = self.type_name()
        outer_subscripts = self.subscripts() if self.token == "[" else ()
        modifiers = frozenset(prefixes)
        parts = []
        while True:
            at = self.place()
            ident = self.ident()
            subscripts = self.subscripts() if self.token == "[" else ()
            modification = self.modification() if self.token in ("(", "=", ":=") else Modification(at)
            condition = self.expression() if self.accept("if") else None
            description, source = self.comment()
            parts.append(
                (at, ident, (*subscripts, *outer_subscripts), modification, condition, description, source)
            )
            if single or not self.accept(","):
                break
        constraint = None
        if self.token == "constrainedby":
            constraint = self.constraint()
            self.comment()
        return [
            ComponentDef(
                at, ident, name, modifiers, subscripts, modification, condition, description, source,
                flags["redeclare"], flags["final"], flags["inner"], flags["outer"], flags["replaceable"],
                constraint, protected,
            )
            for at, ident, subscripts, modification, condition, description, source in parts
        ]  # fmt: skip

    # ---- modifications

    def modification(self) -> Modification:
        at = self.place()
        arguments = self.class_modification() if self.token == "(" else ()
        value = None
        broken = False
        if self.token in ("=", ":="):
            self.i += 1
            if self.accept("break"):
                broken = True
            else:
                value = self.expression()
        return Modification(at, arguments, value, broken)

    def class_modification(self) -> tuple[Argument | Redeclaration, ...]:
        self.expect("(")
        out: list[Argument | Redeclaration] = []
        while self.token != ")":
            out.append(self.argument())
            if not self.accept(","):
                break
        self.expect(")")
        return tuple(out)

    def argument(self) -> Argument | Redeclaration:
        at = self.place()
        if self.token == "redeclare":
            self.i += 1
            each, final = self.accept("each"), self.accept("final")
            return self.redeclaration(at, each, final, redeclare=True)
        each = self.accept("each")
        final = self.accept("final")
        if self.token == "replaceable":
            return self.redeclaration(at, each, final, redeclare=False)
        if self.token == "break":
            self.fail("'break' in a modification is not supported")
        names = self.dotted().split(".")
        modification = self.modification() if self.token in ("(", "=", ":=") else Modification(at)
        self.string_comment()
        if self.token == "annotation":
            self.annotation()
        for name in reversed(names[1:]):
            modification = Modification(at, (Argument(at, name, modification, each, final),))
        return Argument(at, names[0], modification, each, final)

    def redeclaration(self, at: Place, each: bool, final: bool, redeclare: bool) -> Redeclaration:
        flags = {"redeclare": redeclare, "final": final, "inner": False, "outer": False,
                 "replaceable": self.accept("replaceable")}  # fmt: skip
        if self.token in _CLASS_START:
            new: ClassDef | ComponentDef = self.class_definition()
            assert isinstance(new, ClassDef)
            new.redeclare, new.replaceable, new.final = redeclare, flags["replaceable"], final
            if self.token == "constrainedby":
                new.constraint = self.constraint()
                self.comment()
        else:
            (new,) = self.component_clause(flags, protected=False, single=True)
        return Redeclaration(at, new, each, final)

    # ---- sections

    def section(self, out: ClassDef) -> None:
        at = self.place()
        initial = self.accept("initial")
        kind = self.token
        if kind not in ("equation", "algorithm"):
            self.fail()
        self.i += 1
        items = []
        item = self.equation if kind == "equation" else self.statement
        while self.token not in _SECTION_START or (
            self.token == "initial" and self.tokens[self.i + 1] not in ("equation", "algorithm")
        ):
            if not self.token:
                raise ModelicaError(f"'{out.name}' does not end", where=out.at)
            items.append(item())
            self.expect(";")
        out.sections.append(Section(at, kind, initial, tuple(items)))

    def external(self, out: ClassDef) -> None:
        at = self.place()
        self.i += 1
        language = "C"
        if self.token.startswith('"'):
            language = self.token[1:-1]
            self.i += 1
        name, target, arguments = "", None, None
        if self.token not in (";", "annotation"):
            reference = self.component_reference()
            if self.accept("="):
                target = reference
                name = self.ident()
            else:
                name = reference.name
            self.expect("(")
            expressions = []
            while self.token != ")":
                expressions.append(self.expression())
                if not self.accept(","):
                    break
            self.expect(")")
            arguments = tuple(expressions)
        if self.token == "annotation":
            self.annotation()
        self.expect(";")
        out.external = External(at, language, name, target, arguments)

    def block(self, item: Any, *ends: str) -> tuple[Any, ...]:
        out = []
        while self.token not in ends:
            if not self.token:
                self.fail()
            out.append(item())
            self.expect(";")
        return tuple(out)

    def structured(self, item: Any) -> Any:
        """Parse if, for, while or when; None if it is none of them."""
        at = self.place()
        token = self.token
        if token == "if":
            self.i += 1
            branches: list[tuple[Expression | None, tuple[Any, ...]]] = []
            condition: Expression | None = self.expression()
            self.expect("then")
            while True:
                branches.append((condition, self.block(item, "elseif", "else", "end")))
                if self.accept("elseif"):
                    condition = self.expression()
                    self.expect("then")
                elif self.accept("else"):
                    condition = None
                else:
                    break
            self.ends("if")
            return IfStatement(at, tuple(branches))
        if token == "for":
            self.i += 1
            iterators = self.iterators()
            self.expect("loop")
            body = self.block(item, "end")
            self.ends("for")
            return ForStatement(at, iterators, body)
        if token == "while":
            self.i += 1
            test = self.expression()
            self.expect("loop")
            body = self.block(item, "end")
            self.ends("while")
            return WhileStatement(at, test, body)
        if token == "when":
            self.i += 1
            whens = []
            test = self.expression()
            self.expect("then")
            while True:
                whens.append((test, self.block(item, "elsewhen", "end")))
                if not self.accept("elsewhen"):
                    break
                test = self.expression()
                self.expect("then")
            self.ends("when")
            return WhenStatement(at, tuple(whens))
        return None

    def ends(self, word: str) -> None:
        self.expect("end")
        self.expect(word)

    def equation(self) -> Any:
        equation = self.structured(self.equation)
        if equation is None:
            at = self.place()
            if self.token == "connect" and self.tokens[self.i + 1] == "(":
                self.i += 2
                a = self.component_reference()
                self.expect(",")
                b = self.component_reference()
                self.expect(")")
                equation = Connect(at, a, b)
            else:
                left = self.simple_expression()
                if self.accept("="):
                    equation = SourceEquation(at, left, self.expression())
                elif isinstance(left, Call):
                    equation = self.call(at, left)
                else:
                    self.fail("'=' is expected here" if self.token != ":=" else "':=' in an equation; write '='")
        self.comment()
        return equation

    def call(self, at: Place, call: Call) -> Any:
        """Make the statement for a call on its own."""
        arguments, named = call.arguments, dict(call.named)

        def argument(position: int, name: str) -> Expression:
            value = arguments[position] if position < len(arguments) else named.get(name)
            if value is None:
                raise ModelicaError(f"{call.function}() lacks its argument '{name}'", where=at)
            return value

        if call.function == "assert":
            level = arguments[2] if len(arguments) > 2 else named.get("level")
            warning = isinstance(level, Reference) and level.name.endswith("AssertionLevel.warning")
            return Assert(at, argument(0, "condition"), argument(1, "message"), warning)
        if call.function == "terminate":
            return Terminate(at, argument(0, "message"))
        if call.function == "reinit":
            state = argument(0, "x")
            if not isinstance(state, Reference):
                raise ModelicaError("reinit() of an expression, which is not a state", where=at)
            return Reinit(at, state, argument(1, "expr"))
        return AssignMany(at, (), call)

    def statement(self) -> Any:
        statement = self.structured(self.statement)
        if statement is None:
            at = self.place()
            if self.token == "(":
                self.i += 1
                targets: list[Reference | None] = []
                while True:
                    targets.append(None if self.token in (",", ")") else self.component_reference())
                    if not self.accept(","):
                        break
                self.expect(")")
                self.expect(":=")
                value = self.expression()
                if not isinstance(value, Call):
                    raise ModelicaError("a function call is expected here", where=at)
                statement = AssignMany(at, tuple(targets), value)
            elif self.accept("return"):
                statement = Return(at)
            elif self.accept("break"):
                statement = Break(at)
            else:
                value = self.primary()
                if isinstance(value, Call):
                    statement = self.call(at, value)
                elif isinstance(value, Reference):
                    self.expect(":=")
                    statement = Assign(at, value, self.expression())
                else:
                    raise ModelicaError("a statement is expected here", where=at)
        self.comment()
        return statement

    # ---- expressions

    def iterators(self) -> tuple[tuple[str, Expression | None], ...]:
        out = []
        while True:
            name = self.ident()
            out.append((name, self.expression() if self.accept("in") else None))
            if not self.accept(","):
                return tuple(out)

    def expression(self) -> Expression:
        if self.token != "if":
            return self.simple_expression()
        at = self.place()
        self.i += 1
        branches = []
        condition = self.expression()
        self.expect("then")
        branches.append((condition, self.expression()))
        while self.accept("elseif"):
            condition = self.expression()
            self.expect("then")
            branches.append((condition, self.expression()))
        self.expect("else")
        return If(at, tuple(branches), self.expression())

    def simple_expression(self) -> Expression:
        first = self.logical()
        if self.token != ":":
            return first
        at = self.place()
        self.i += 1
        second = self.logical()
        if self.accept(":"):
            return Range(at, first, second, self.logical())
        return Range(at, first, None, second)

    def logical(self) -> Expression:
        left = self.logical_term()
        while self.token == "or":
            at = self.place()
            self.i += 1
            left = Binary(at, "or", left, self.logical_term())
        return left

    def logical_term(self) -> Expression:
        left = self.logical_factor()
        while self.token == "and":
            at = self.place()
            self.i += 1
            left = Binary(at, "and", left, self.logical_factor())
        return left

    def logical_factor(self) -> Expression:
        if self.token == "not":
            at = self.place()
            self.i += 1
            return Unary(at, "not", self.logical_factor())
        left = self.arithmetic()
        if self.token in _RELATIONS:
            at, operator = self.place(), self.token
            self.i += 1
            return Binary(at, operator, left, self.arithmetic())
        return left

    def arithmetic(self) -> Expression:
        if self.token in _SUMS:
            at, operator = self.place(), self.token
            self.i += 1
            operand = self.term()
            left: Expression = Unary(at, operator, operand)
        else:
            left = self.term()
        while self.token in _SUMS:
            at, operator = self.place(), self.token
            self.i += 1
            left = Binary(at, operator, left, self.term())
        return left

    def term(self) -> Expression:
        left = self.factor()
        while self.token in _PRODUCTS:
            at, operator = self.place(), self.token
            self.i += 1
            left = Binary(at, operator, left, self.factor())
        return left

    def factor(self) -> Expression:
        left = self.primary()
        if self.token in ("^", ".^"):
            at, operator = self.place(), self.token
            self.i += 1
            return Binary(at, operator, left, self.primary())
        return left

    def primary(self) -> Expression:
        at, token = self.place(), self.token
        first = token[:1]
        literal = _literal(at, token)
        if literal is not None:
            self.i += 1
            return literal
        opened = {"(": self.parenthesised, "{": self.array, "[": self.matrix}.get(token)
        if opened is not None:
            return opened(at)
        if token in _FUNCTIONS and self.tokens[self.i + 1] == "(":
            self.i += 1
            return self.function_call(at, token, rooted=False)
        if token in _KEYWORDS or not (first == "." or _NAME.match(token)):
            self.fail()
        reference = self.component_reference()
        if self.token == "(":
            if any(part.subscripts for part in reference.parts):
                self.fail()
            return self.function_call(at, reference.name, reference.rooted)
        return reference

    def array(self, at: Place) -> Expression:
        self.i += 1
        out = self.array_arguments(at, "}")
        self.expect("}")
        return out

    def parenthesised(self, at: Place) -> Expression:
        self.i += 1
        items: list[Expression | None] = []
        while True:
            items.append(None if self.token in (",", ")") else self.expression())
            if not self.accept(","):
                break
        self.expect(")")
        if len(items) != 1 or items[0] is None:
            return TupleOf(at, tuple(items))
        if self.token == "[":
            return Subscripted(at, items[0], self.subscripts())
        return items[0]

    def array_arguments(self, at: Place, end: str) -> Expression:
        items: list[Expression] = []
        while self.token != end:
            items.append(self.expression())
            if self.accept("for"):
                return Comprehension(at, items[0], self.iterators())
            if not self.accept(","):
                break
        return ArrayOf(at, tuple(items))

    def matrix(self, at: Place) -> Expression:
        self.i += 1
        rows = []
        while True:
            row = [self.expression()]
            while self.accept(","):
                row.append(self.expression())
            rows.append(tuple(row))
            if not self.accept(";"):
                break
        self.expect("]")
        return Matrix(at, tuple(rows))

    def function_call(self, at: Place, name: str, rooted: bool) -> Call:
        self.expect("(")
        arguments: list[Expression | None] = []
        named: list[tuple[str, Expression]] = []
        while self.token != ")":
            if _NAME.match(self.token) and self.tokens[self.i + 1] == "=":
                key = self.ident()
                self.i += 1
                named.append((key, self.function_argument()))
            else:
                if named:
                    self.fail("a positional argument follows a named one")
                arguments.append(self.function_argument())
                if self.accept("for"):
                    element = arguments[0]
                    assert element is not None
                    arguments = [Comprehension(at, element, self.iterators())]
            if not self.accept(","):
                break
        self.expect(")")
        return Call(at, name, tuple(arguments), tuple(named), rooted)

    def function_argument(self) -> Expression:
        if self.token != "function":
            return self.expression()
        at = self.place()
        self.i += 1
        reference = self.type_name()
        return PartialCall(at, self.function_call(at, reference.name, reference.rooted))

    def component_reference(self) -> Reference:
        at = self.place()
        rooted = self.accept(".")
        parts = []
        while True:
            name = self.ident()
            parts.append(Part(name, self.subscripts() if self.token == "[" else ()))
            if self.token != ".":
                return Reference(at, tuple(parts), rooted)
            self.i += 1

    def subscripts(self) -> tuple[Expression, ...]:
        self.expect("[")
        out: list[Expression] = []
        while True:
            if self.token == ":" and self.tokens[self.i + 1] in (",", "]"):
                out.append(All(self.place()))
                self.i += 1
            else:
                out.append(self.expression())
            if not self.accept(","):
                break
        self.expect("]")
        return tuple(out)


def _literal(at: Place, token: str) -> Expression | None:
    """Return a number, String or truth value, or ``end`` in a subscript."""
    first = token[:1]
    if first.isdigit() or (first == "." and len(token) > 1):
        return Literal(at, int(token) if token.isdigit() else float(token))
    if first == '"':
        return Literal(at, unescaped(token[1:-1]))
    if token in ("true", "false"):
        return Literal(at, token == "true")
    return End(at) if token == "end" else None
