"""Translation of a subset of Python to JavaScript, so that a page runs the same readers of programs
as the command.

The subset is what the modules of :mod:`pincal.programs` use: functions, classes and dataclasses,
comprehensions, generators, and the methods of strings, lists, dictionaries and sets, which the
page's ``python.js`` implements. Anything else is refused with its line.

No compiler that is kept up translates these modules: of their 150 functions pscript 0.8 refuses 69
(generators, sets, matrices) and takes a tuple as a key for a slice; Transcrypt 3.9 stops at a
dataclass.
"""

from __future__ import annotations

import ast
import json
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import TypeGuard

# Reserved words of JavaScript; built-in functions of Python; methods of strings, lists,
# dictionaries and sets, which the page's python.js dispatches by type.
_WORDS = """
arguments break case catch class const continue default delete do else enum export extends false
finally for function if import in instanceof let new null package private protected public return
static super switch this throw true try typeof var void while with yield
"""
_FUNCTIONS = """
len str int float bool set frozenset tuple list dict sorted min max sum any all next enumerate zip
range map filter abs round reversed hasattr getattr replace isinstance
"""
_METHODS = """
upper lower split partition strip lstrip rstrip startswith endswith removesuffix removeprefix
replace join isdigit isalpha rjust find rfind append pop items keys values get setdefault update
add union fromkeys index count
"""
_RESERVED, _BUILTIN, _SHARED = (
    frozenset(words.split()) for words in (_WORDS, _FUNCTIONS, _METHODS)
)
# Operations of two operands: of Python's types by python.js, and of numbers.
_OPERATIONS: dict[type, str] = {
    **{
        kind: f"py.{name}({{0}}, {{1}})"
        for kind, name in {
            ast.Add: "add",
            ast.BitOr: "or",
            ast.BitAnd: "and",
            ast.Sub: "sub",
            ast.MatMult: "matmul",
            ast.Eq: "same",
        }.items()
    },
    **{
        kind: f"({{0}} {sign} {{1}})"
        for kind, sign in {
            ast.Mult: "*",
            ast.Div: "/",
            ast.LShift: "<<",
            ast.RShift: ">>",
            ast.Pow: "**",
            ast.Lt: "<",
            ast.LtE: "<=",
            ast.Gt: ">",
            ast.GtE: ">=",
        }.items()
    },
    ast.NotEq: "!py.same({0}, {1})",
    ast.In: "py.has({1}, {0})",
    ast.NotIn: "!py.has({1}, {0})",
    ast.Is: "(({0}) ?? null) === ({1})",
    ast.IsNot: "(({0}) ?? null) !== ({1})",
}


@dataclass
class Translator:
    """Translates the modules of a package.

    Attributes:
        skip: names of functions, methods (``Class.method``) and classes that the page implements
            itself.
        signatures: names of the parameters of functions, methods and classes, by their names.
    """

    skip: frozenset[str] = frozenset()
    signatures: dict[str, list[list[str]]] = field(default_factory=dict)
    _fields: dict[str, list[tuple[str, str]]] = field(default_factory=dict)

    def translate(self, modules: Mapping[str, str]) -> str:
        """Return modules, given as texts by name, in their order as constants ``MODULES.name``.

        Raises:
            NotImplementedError: for Python outside the subset.
        """
        trees = {name: ast.parse(text) for name, text in modules.items()}
        for tree in trees.values():
            self._take_signatures(tree)
        return "\n".join(self._module(name, tree, modules) for name, tree in trees.items())

    def _take_signatures(self, tree: ast.Module) -> None:
        for node in ast.walk(tree):
            if isinstance(node, ast.FunctionDef):
                names = [
                    a.arg for a in (*node.args.posonlyargs, *node.args.args, *node.args.kwonlyargs)
                ]
                self.signatures.setdefault(node.name, []).append(
                    [name for name in names if name not in ("self", "cls")]
                )
        for node in tree.body:
            if isinstance(node, ast.ClassDef):
                if node.name in self._fields:
                    # Their fields and signatures are known by the name only.
                    raise NotImplementedError(f"two classes are named {node.name}; rename one")
                inherited = [
                    one for base in node.bases for one in self._fields.get(_name(base), [])
                ]
                own = [
                    (part.target.id, "null" if part.value is None else self._default(part.value))
                    for part in node.body
                    if isinstance(part, ast.AnnAssign)
                    and isinstance(part.target, ast.Name)
                    and "ClassVar" not in ast.unparse(part.annotation)
                ]
                self._fields[node.name] = inherited + own
                self.signatures[node.name] = [[name for name, _ in self._fields[node.name]]]

    def _default(self, node: ast.expr) -> str:
        if isinstance(node, ast.Call) and _name(node.func) == "field":
            for keyword in node.keywords:
                if keyword.arg == "default_factory":
                    made = keyword.value
                    return (
                        self._expression(made.body)
                        if isinstance(made, ast.Lambda)
                        else f"py.{_name(made)}()"
                    )
        return self._expression(node)

    def _module(self, name: str, tree: ast.Module, modules: Mapping[str, str]) -> str:
        lines = []
        names = []
        for node in tree.body:
            if isinstance(node, ast.ImportFrom):
                source = (node.module or "").rpartition(".")[2]
                taken = [alias.name for alias in node.names if alias.name not in self.skip]
                if source in modules and taken:
                    lines.append(f"const {{ {', '.join(taken)} }} = MODULES.{source};")
            elif isinstance(node, (ast.FunctionDef, ast.ClassDef)) and node.name not in self.skip:
                lines += self._statement(node)
                names.append(node.name)
            elif isinstance(node, (ast.Assign, ast.AnnAssign)) and not isinstance(
                node.value, ast.Subscript
            ):
                target = node.targets[0] if isinstance(node, ast.Assign) else node.target
                if _name(target) not in self.skip:
                    names += _targets(target)
                    lines += [f"let {', '.join(_targets(target))};", *self._statement(node)]
            elif isinstance(node, ast.AugAssign):
                lines += self._statement(node)
        return (
            f"MODULES.{name} = (() => {{\n"
            + "\n".join(lines)
            + f"\nreturn {{ {', '.join(names)} }};\n}})();"
        )

    # --- statements

    def _block(self, nodes: Iterable[ast.stmt]) -> list[str]:
        return [line for node in nodes for line in self._statement(node)]

    def _statement(self, node: ast.stmt) -> list[str]:
        match node:
            case ast.FunctionDef():
                return self._function(
                    node, f"function{'*' if _yields(node) else ''} {_plain(node.name)}"
                )
            case ast.ClassDef():
                return self._class(node)
            case ast.Return():
                return [f"return {self._expression(node.value) if node.value else 'null'};"]
            case ast.If():
                lines = [f"if ({self._truth(node.test)}) {{", *self._block(node.body)]
                return (
                    [*lines, "} else {", *self._block(node.orelse), "}"]
                    if node.orelse
                    else [*lines, "}"]
                )
            case ast.For(target, iterated, body, [], _):
                head = f"for (const $each of py.iter({self._expression(iterated)})) {{"
                return [head, f"{self._target(target)} = $each;", *self._block(body), "}"]
            case ast.While(test, body, []):
                return [f"while ({self._truth(test)}) {{", *self._block(body), "}"]
            case ast.Assign([target], value) | ast.AnnAssign(target, _, ast.expr() as value):
                return [self._assigned(target, self._expression(value))]
            case ast.AnnAssign() | ast.Pass() | ast.Expr(ast.Constant(str())):
                return []
            case ast.AugAssign(target, operator, value):
                return [self._assigned(target, self._operation(operator, target, value))]
            case ast.Expr(value):
                return [f"{self._expression(value)};"]
            case ast.Raise(exc) if exc is not None:
                return [f"throw {self._expression(exc)};"]
            case ast.Continue():
                return ["continue;"]
            case ast.Try(body, [ast.ExceptHandler(ast.Name(kind), None, handler)], [], []):
                caught = f"}} catch ($error) {{ if (!($error instanceof py.{kind})) throw $error;"
                return ["try {", *self._block(body), caught, *self._block(handler), "}"]
        raise _unknown(node)

    def _assigned(self, target: ast.expr, value: str) -> str:
        if isinstance(target, ast.Subscript):
            return (
                f"py.put({self._expression(target.value)}, {self._expression(target.slice)}, "
                f"{value});"
            )
        return (
            f"{self._target(target)} = "
            f"{f'[...py.iter({value})]' if isinstance(target, ast.Tuple) else value};"
        )

    def _target(self, target: ast.expr) -> str:
        if isinstance(target, (ast.Tuple, ast.List)):
            names = ("" if _name(part) == "_" else self._target(part) for part in target.elts)
            return f"[{', '.join(names)}]"
        if isinstance(target, ast.Starred):
            return f"...{self._target(target.value)}"
        return self._expression(target)

    def _function(self, node: ast.FunctionDef, head: str) -> list[str]:
        given = [*node.args.posonlyargs, *node.args.args]
        defaults = [None] * (len(given) - len(node.args.defaults)) + list(node.args.defaults)
        pairs = [
            *zip(given, defaults, strict=True),
            *zip(node.args.kwonlyargs, node.args.kw_defaults, strict=True),
        ]
        names = [(_plain(a.arg), value) for a, value in pairs if a.arg not in ("self", "cls")]
        if node.args.kwarg or node.args.vararg:
            raise _unknown(node)
        parameters = ", ".join(
            name if value is None else f"{name} = {self._expression(value)}"
            for name, value in names
        )
        local = sorted(set(_locals(node.body)) - {name for name, _ in names})
        lines = [f"{head}({parameters}) {{"] + ([f"let {', '.join(local)};"] if local else [])
        return [*lines, *self._block(node.body), *([] if _yields(node) else ["return null;"]), "}"]

    def _class(self, node: ast.ClassDef) -> list[str]:
        bases = [_name(base) for base in node.bases if _name(base) not in ("ABC", "Generic")]
        lines = [f"class {node.name}{f' extends {bases[0]}' if bases else ''} {{"]
        fields = self._fields[node.name]
        if fields:
            parameters = ", ".join(f"{_plain(name)} = {default}" for name, default in fields)
            sets = [f"this.{name} = {_plain(name)};" for name, _ in fields]
            lines += [f"constructor({parameters}) {{", *(["super();"] if bases else []), *sets, "}"]
        constants = []
        for part in node.body:
            if isinstance(part, ast.FunctionDef) and f"{node.name}.{part.name}" not in self.skip:
                kinds = {_name(decorator) for decorator in part.decorator_list}
                prefix = (
                    "get "
                    if kinds & {"property", "cached_property"}
                    else "*"
                    if _yields(part)
                    else ""
                )
                lines += self._function(part, prefix + part.name)
                if "cached_property" in kinds:
                    constants.append(f"py.cached({node.name}.prototype, {as_text(part.name)});")
            elif isinstance(part, ast.Assign) or _is_class_variable(part):
                target = part.targets[0] if isinstance(part, ast.Assign) else part.target
                if part.value is not None:
                    constants.append(
                        f"{node.name}.prototype.{_name(target)} = {self._expression(part.value)};"
                    )
        registered = [
            f"LANGUAGES.register({node.name});"
            for d in node.decorator_list
            if _name(d) == "register"
        ]
        return [*lines, "}", *constants, *registered]

    # --- expressions

    def _truth(self, node: ast.expr) -> str:
        match node:
            case ast.Compare() | ast.UnaryOp(ast.Not()):
                return self._expression(node)
        return f"py.truth({self._expression(node)})"

    def _list(self, nodes: Iterable[ast.expr]) -> str:
        return ", ".join(
            f"...py.iter({self._expression(n.value)})"
            if isinstance(n, ast.Starred)
            else self._expression(n)
            for n in nodes
        )

    def _expression(self, node: ast.expr) -> str:
        match node:
            case ast.Constant(None):
                return "null"
            case ast.Constant(bool(value)):
                return str(value).lower()
            case ast.Constant(int() | float() as value):
                return repr(value)
            case ast.Constant(str(value)):
                return as_text(value)
            case ast.Name("self"):
                return "this"
            case ast.Name(name):
                return f"py.{name}" if name in _BUILTIN else _plain(name)
            case ast.Attribute(value, name):
                return f"{self._expression(value)}.{name}"
            case ast.Subscript(value, ast.Slice(lower, upper, None)):
                ends = [self._expression(end) if end else "undefined" for end in (lower, upper)]
                return f"py.text({self._expression(value)}).slice({', '.join(ends)})"
            case ast.Subscript(value, index):
                return f"py.at({self._expression(value)}, {self._expression(index)})"
            case ast.Tuple(elements) | ast.List(elements):
                return f"[{self._list(elements)}]"
            case ast.Set(elements):
                return f"new Set([{self._list(elements)}])"
            case ast.Dict(keys, values):
                return f"new py.Dict([{', '.join(map(self._pair, keys, values))}])"
            case ast.ListComp(element, generators) | ast.GeneratorExp(element, generators):
                return self._comprehension(self._expression(element), generators)
            case ast.SetComp(element, generators):
                return f"new Set({self._comprehension(self._expression(element), generators)})"
            case ast.DictComp(key, value, generators):
                pair = f"[{self._expression(key)}, {self._expression(value)}]"
                return f"new py.Dict({self._comprehension(pair, generators)})"
            case ast.IfExp(test, body, orelse):
                return (
                    f"({self._truth(test)} ? {self._expression(body)} : {self._expression(orelse)})"
                )
            case ast.BoolOp(operator, values):
                *rest, last = [self._expression(value) for value in values]
                for value in reversed(rest):
                    last = (
                        f"py.{'both' if isinstance(operator, ast.And) else 'either'}({value}, "
                        f"() => {last})"
                    )
                return last
            case ast.UnaryOp(ast.Not(), value):
                if isinstance(value, ast.Compare):
                    return f"!({self._expression(value)})"
                return f"!{self._truth(value)}"
            case ast.UnaryOp(ast.USub(), value):
                return f"-{self._expression(value)}"
            case ast.UnaryOp(ast.Invert(), value):
                return f"~{self._expression(value)}"
            case ast.BinOp(left, operator, right):
                return self._operation(operator, left, right)
            case ast.Compare(left, operators, rights):
                parts = [
                    self._operation(*pair)
                    for pair in zip(operators, [left, *rights], rights, strict=False)
                ]
                return parts[0] if len(parts) == 1 else f"({' && '.join(parts)})"
            case ast.JoinedStr(parts):
                return f"({' + '.join([self._formatted(part) for part in parts]) or as_text('')})"
            case ast.Lambda(arguments, body):
                return (
                    f"(({', '.join(_plain(a.arg) for a in arguments.args)}) => "
                    f"{self._expression(body)})"
                )
            case ast.NamedExpr(target, value):
                return f"({self._expression(target)} = {self._expression(value)})"
            case ast.Yield(value) if value is not None:
                return f"(yield {self._expression(value)})"
            case ast.YieldFrom(value):
                return f"(yield* py.iter({self._expression(value)}))"
            case ast.Call():
                return self._call(node)
        raise _unknown(node)

    def _pair(self, key: ast.expr | None, value: ast.expr) -> str:
        if key is None:
            return f"...py.iter(py.call({self._expression(value)}, 'items'))"
        return f"[{self._expression(key)}, {self._expression(value)}]"

    def _comprehension(self, element: str, generators: Sequence[ast.comprehension]) -> str:
        inner = f"$out.push({element});"
        for generator in reversed(generators):
            tests = "".join(f"if ({self._truth(test)}) " for test in generator.ifs)
            each = (
                f"const {self._target(generator.target)} of "
                f"py.iter({self._expression(generator.iter)})"
            )
            inner = f"for ({each}) {{ {tests}{inner} }}"
        return f"(() => {{ const $out = []; {inner} return $out; }})()"

    def _operation(
        self, operator: ast.operator | ast.cmpop, left: ast.expr, right: ast.expr
    ) -> str:
        if type(operator) not in _OPERATIONS:
            raise _unknown(operator)
        return _OPERATIONS[type(operator)].format(self._expression(left), self._expression(right))

    def _formatted(self, node: ast.expr) -> str:
        if not isinstance(node, ast.FormattedValue):
            return self._expression(node)
        value = self._expression(node.value)
        if node.format_spec is not None:
            return f"py.format({value}, {self._expression(node.format_spec)})"
        return f"py.{'repr' if node.conversion == ord('r') else 'str'}({value})"

    def _call(self, node: ast.Call) -> str:
        called = node.func.value if isinstance(node.func, ast.Subscript) else node.func
        name = _name(called)
        if name == "super":
            return "super"
        arguments = self._arguments(node, name)
        if isinstance(called, ast.Name):
            if name == "isinstance":
                kinds = node.args[1].elts if isinstance(node.args[1], ast.Tuple) else [node.args[1]]
                words = [
                    as_text(_name(kind)) if _name(kind) in ("str", "int", "float") else _name(kind)
                    for kind in kinds
                ]
                return f"py.isinstance({self._expression(node.args[0])}, [{', '.join(words)}])"
            if name in _BUILTIN:
                return f"py.{name}({arguments})"
            is_made = name in self._fields or name.endswith("Error")
            return f"{'new ' if is_made else ''}{_plain(name)}({arguments})"
        if not isinstance(called, ast.Attribute):
            raise _unknown(node)
        if name == "fromkeys":
            return f"py.fromkeys({arguments})"
        owner = self._expression(called.value)
        if name in _SHARED and owner != "super":
            return f"py.call({owner}, {as_text(name)}{', ' if arguments else ''}{arguments})"
        return f"{owner}.{name}({arguments})"

    def _arguments(self, node: ast.Call, name: str) -> str:
        """Return the arguments in order, keyword arguments at their positions in the signature."""
        if name in _BUILTIN or name in ("zip", "fromkeys"):
            keywords = {
                k.arg: self._expression(k.value) for k in node.keywords if k.arg != "strict"
            }
            last = (
                [f"{{ {', '.join(f'{key}: {value}' for key, value in keywords.items())} }}"]
                if keywords
                else []
            )
            return ", ".join(filter(None, [self._list(node.args), *last]))
        if not node.keywords:
            return self._list(node.args)
        given = {keyword.arg: self._expression(keyword.value) for keyword in node.keywords}
        fitting = [
            names
            for names in self.signatures.get(name, ())
            if set(given) <= set(names[len(node.args) :])
        ]
        orders = {tuple(names.index(key) for key in given if key) for names in fitting}
        if len(orders) != 1 or any(isinstance(one, ast.Starred) for one in node.args):
            raise _unknown(node)
        names = fitting[0]
        places = [
            *map(self._expression, node.args),
            *("undefined" for _ in names[len(node.args) :]),
        ]
        for key, value in given.items():
            places[names.index(str(key))] = value
        while places and places[-1] == "undefined":
            places.pop()
        return ", ".join(places)


def _name(node: ast.expr) -> str:
    """Return the last name of an expression."""
    return (
        node.id
        if isinstance(node, ast.Name)
        else node.attr
        if isinstance(node, ast.Attribute)
        else ""
    )


def _is_class_variable(node: ast.stmt) -> TypeGuard[ast.AnnAssign]:
    return (
        isinstance(node, ast.AnnAssign)
        and node.value is not None
        and "ClassVar" in ast.unparse(node.annotation)
    )


def _plain(name: str) -> str:
    return f"{name}_" if name in _RESERVED else name


def as_text(value: str) -> str:
    """Return a string literal that is safe within a script element."""
    return json.dumps(value).replace("<", "\\u003c").replace(">", "\\u003e")


def _targets(node: ast.expr) -> list[str]:
    if isinstance(node, (ast.Tuple, ast.List)):
        return [name for element in node.elts for name in _targets(element)]
    if isinstance(node, ast.Starred):
        return _targets(node.value)
    return [_plain(node.id)] if isinstance(node, ast.Name) else []


def _locals(nodes: Iterable[ast.stmt]) -> Iterator[str]:
    """Yield the names that statements assign, except within comprehensions."""
    for statement in nodes:
        for node in ast.walk(statement):
            if isinstance(node, ast.Assign):
                yield from _targets(node.targets[0])
            elif isinstance(node, (ast.AugAssign, ast.AnnAssign, ast.For, ast.NamedExpr)):
                yield from _targets(node.target)


def _yields(node: ast.FunctionDef) -> bool:
    return any(isinstance(inner, (ast.Yield, ast.YieldFrom)) for inner in ast.walk(node))


def _unknown(node: ast.AST) -> NotImplementedError:
    line = getattr(node, "lineno", "?")
    return NotImplementedError(
        f"line {line}: {ast.unparse(node)[:80]} is not translated to JavaScript"
    )
