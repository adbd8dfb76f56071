"""The flags of a command, read from the source of its config: importing PyTorch and LeRobot takes many seconds.

`--help` and a flag that does not exist are so answered at once.
"""

from __future__ import annotations

import ast
import re
import textwrap
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cache
from importlib.util import find_spec
from pathlib import Path
from pkgutil import iter_modules

REGISTERED = re.compile(r"register_subclass\(\s*(?:name=)?[\"'](\w+)[\"']\s*\)(?=\s*\n(?:@[^\n]*\n)*class (\w+))")
"""A config that is one type of a choice."""
DEFAULT_TYPES = {"env": "cronos", "algorithm": "ppo"}
WIDTH = 100


@dataclass(frozen=True)
class Flag:
    """One flag."""

    name: str
    kind: str
    """Its type, as in the source."""
    default: str
    text: str


@dataclass(frozen=True)
class Source:
    """A class in a file."""

    file: Path
    node: ast.ClassDef


def read_flags(source: Source, arguments: Sequence[str]) -> list[Flag]:
    """The flags of a config, those of choices by the types that the arguments or defaults name.

    A choice whose type is not known has the one flag `<name>.*`.
    """
    # A class may give a field of its base another default.
    return list({flag.name: flag for flag in _flags(source, arguments, "")}.values())


def check_flags(flags: Sequence[Flag], arguments: Sequence[str]) -> str | None:
    """What is wrong with the arguments' flags, which may not exist or be null; None if nothing is."""
    known = {flag.name: flag for flag in flags}
    given = [flag.removeprefix("--").partition("=") for flag in join_values(arguments) if flag.startswith("--")]
    # Of a policy's checkpoint and of your own modules nothing is known here.
    open_groups = [name.removesuffix("*") for name in known if name.endswith(".*")]
    open_groups += [name.removesuffix("path") for name, _, _ in given if name.endswith(".path")]
    has_plugins = any("discover_packages_path" in argument for argument in arguments)
    for name, _, value in given:
        if flag := known.get(name):
            # draccus gives None to numbers and booleans, too.
            if value in ("null", "~") and flag.kind in ("int", "float", "bool") and flag.default != "None":
                return f"null is no value of --{name}"
        elif not (has_plugins or name == "config_path" or name.startswith(tuple(open_groups))):
            return f"unrecognized arguments: --{name}={value}"
    return None


def join_values(arguments: Sequence[str]) -> list[str]:
    """The arguments with `--name value` as `--name=value`."""
    joined: list[str] = []
    for argument in arguments:
        if joined and joined[-1].startswith("--") and "=" not in joined[-1] and not argument.startswith("--"):
            argument = f"{joined.pop()}={argument}"
        joined.append(argument)
    return joined


def format_flags(flags: Sequence[Flag]) -> str:
    """What `--help` says of flags."""
    parts = []
    for flag in flags:
        value = flag.kind + (f", default {flag.default}" if flag.default else "")
        parts.append(f"  --{flag.name}  ({value})")
        parts += textwrap.wrap(flag.text, WIDTH, initial_indent="      ", subsequent_indent="      ")
    return "\n".join(parts)


def find_class(module: str, name: str) -> Source:
    """The class `name` of a module, which is not imported."""
    found = _find(_file_of(module.split(".")), name)
    assert found is not None, f"{module} has no {name}"
    return found


def find_commands(module: str) -> dict[str, Source]:
    """The configs of a module's COMMANDS, by their names."""
    file = _file_of(module.split("."))
    assigned = (node for node in _tree(file).body if isinstance(node, ast.AnnAssign))
    table = next(node.value for node in assigned if ast.unparse(node.target) == "COMMANDS")
    assert isinstance(table, ast.Dict)
    names = {ast.literal_eval(key): ast.unparse(value.elts[0]) for key, value in zip(table.keys, table.values)}  # ty: ignore
    return {key: found for key, name in names.items() if (found := _find(file, name)) is not None}


def docstring_of(module: str) -> str:
    """The docstring of a module, which is not imported."""
    return ast.get_docstring(_tree(_file_of(module.split(".")))) or ""


def _flags(source: Source, arguments: Sequence[str], prefix: str) -> Iterator[Flag]:
    for base in source.node.bases:
        if (found := _find(source.file, ast.unparse(base))) is not None:
            yield from _flags(found, arguments, prefix)
    lines = source.file.read_text().splitlines()
    body = source.node.body
    for field, following in zip(body, [*body[1:], None], strict=True):
        if not isinstance(field, ast.AnnAssign) or re.search("ClassVar|init=False", ast.unparse(field)):
            continue
        name, kind = f"{prefix}{ast.unparse(field.target)}", ast.unparse(field.annotation)
        text = _docstring(following) or _comment(lines, field.lineno - 1)
        inner = _find(source.file, kind.removesuffix(" | None"))
        if inner is None or not _is_config(inner):
            yield Flag(name, kind, _default(field.value), text)
        else:
            yield Flag(name, "file", "", text)
            yield from _inner_flags(inner, arguments, name)


def _inner_flags(inner: Source, arguments: Sequence[str], name: str) -> Iterator[Flag]:
    """The flags of a config in a config; of a choice, of the type that is chosen."""
    types = _types(inner.node.name)
    if not types:
        yield from _flags(inner, arguments, f"{name}.")
        return
    given = [a.partition("=")[2] for a in arguments if a.startswith(f"--{name}.type=")]
    chosen = (given or [DEFAULT_TYPES.get(name, "")])[-1]
    yield Flag(f"{name}.type", "|".join(types), DEFAULT_TYPES.get(name, ""), "")
    if chosen in types:
        yield from _flags(types[chosen], arguments, f"{name}.")
    else:
        yield Flag(f"{name}.*", "of its type", "", f"--{name}.type=<type> --help lists them.")


@cache
def _types(base: str) -> dict[str, Source]:
    """The registered types of a choice, by their names; none if the class is no choice."""
    ours = _file_of(["cronos_lerobot"]).parent
    files = {
        "EnvConfig": [*_file_of(["lerobot_env_cronos"]).parent.glob("*config.py"), ours / "robot/config.py"],
        "RLAlgorithmConfig": [*ours.glob("agents/**/config.py")],
        "PreTrainedConfig": _files_of_plugins("policies", "lerobot_policy_", "configuration_*.py"),
        "RobotConfig": _files_of_plugins("robots", "lerobot_robot_", "config*.py"),
        "TeleoperatorConfig": _files_of_plugins("teleoperators", "lerobot_robot_", "config*.py")
        + _files_of_plugins("teleoperators", "lerobot_teleoperator_", "config*.py"),
    }.get(base, [])
    found = {name: (file, kind) for file in files for name, kind in REGISTERED.findall(file.read_text())}
    sources = {name: _find(file, kind) for name, (file, kind) in sorted(found.items())}
    return {name: source for name, source in sources.items() if source is not None}


def _files_of_plugins(room: str, prefix: str, pattern: str) -> list[Path]:
    """The files of configs in a room of LeRobot, and in the packages that it finds by their names."""
    folders = [_file_of(["lerobot", room]).parent]
    folders += [_file_of([m.name]).parent for m in iter_modules() if m.name.startswith(prefix)]
    return [file for folder in folders for file in folder.rglob(pattern)]


@cache
def _find(file: Path, name: str) -> Source | None:
    """The class that `name` means in a file, wherever it is imported from; None if it is none of a package's."""
    for node in _tree(file).body:
        if isinstance(node, ast.ClassDef) and node.name == name:
            return Source(file, node)
        if isinstance(node, ast.ImportFrom) and name in [alias.asname or alias.name for alias in node.names]:
            path = node.module.split(".") if node.module else []
            try:
                origin = _file_of(path) if not node.level else _below(file.parents[node.level - 1], path)
            except (FileNotFoundError, ModuleNotFoundError):
                return None
            return _find(origin, name)
    return None


def _file_of(path: list[str]) -> Path:
    """The file of a module, by the parts of its name. Only its top package is looked up, which imports nothing."""
    spec = find_spec(path[0])
    if spec is None or not spec.submodule_search_locations:
        raise ModuleNotFoundError(path[0])
    return _below(Path(spec.submodule_search_locations[0]), path[1:])


def _below(folder: Path, path: list[str]) -> Path:
    place = folder.joinpath(*path)
    file = place.with_suffix(".py") if path and not place.is_dir() else place / "__init__.py"
    if not file.is_file():
        raise FileNotFoundError(file)
    return file


@cache
def _tree(file: Path) -> ast.Module:
    return ast.parse(file.read_text())


def _is_config(source: Source) -> bool:
    return any("dataclass" in ast.unparse(decorator) for decorator in source.node.decorator_list)


def _default(value: ast.expr | None) -> str:
    if value is None:
        return ""
    if isinstance(value, ast.Call):
        # `ranged(1, minimum=1)`, or a factory.
        return ast.unparse(value.args[0]) if value.args else ""
    return ast.unparse(value)


def _docstring(node: ast.stmt | None) -> str:
    if isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant) and isinstance(node.value.value, str):
        return " ".join(node.value.value.split())
    return ""


def _comment(lines: list[str], index: int) -> str:
    """The comment above a line, with which LeRobot documents its configs."""
    found: list[str] = []
    while index > 0 and (line := lines[index - 1].strip()).startswith("#"):
        found.insert(0, line.removeprefix("#").strip())
        index -= 1
    return " ".join(found)
