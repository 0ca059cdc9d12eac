"""What every subcommand shares: its parser, the flags generated from Config, settings files, paths to write."""

import argparse
import difflib
import os
import sys
from collections.abc import Collection, Iterable
from pathlib import Path
from typing import Any, NoReturn

from pnv_core.config import Config
from pnv_core.errors import ConfigError
from pnv_core.settings import Setting, settings_of

_BOOLEANS = {"true": True, "1": True, "yes": True, "false": False, "0": False, "no": False}
ALWAYS_SHOWN = ("weights", "preset", "device")


class CommandParser(argparse.ArgumentParser):
    """Refuses in one line, names the nearest option, and shows the settings of the recogniser with --help-all only."""

    def __init__(self, **kwargs: Any) -> None:
        super().__init__(**{"allow_abbrev": False} | kwargs)
        self.settings_help: list[tuple[argparse.Action, str]] = []  # hidden from --help

    def error(self, message: str) -> NoReturn:
        print(f"{self.prog}: {message}   (help: {self.prog} --help)", file=sys.stderr)
        sys.exit(2)

    def parse_command(self, argv: list[str]) -> argparse.Namespace:
        """The parsed arguments. An unknown option is refused before its value could be taken for a path."""
        known = _options(self)
        flags = argv[: argv.index("--")] if "--" in argv else argv
        for flag in (text.partition("=")[0] for text in flags if text.startswith("--")):
            if flag not in known:
                self.error(f"unrecognized arguments: {flag}{hint(flag, known)}")
        return self.parse_args(argv)


def hint(given: str, known: Iterable[str]) -> str:
    """ "; did you mean X?" where a known name is near the given one, else nothing."""
    near = difflib.get_close_matches(given, list(known), 1, 0.6)
    return f"; did you mean {near[0]}?" if near else ""


def _options(parser: argparse.ArgumentParser) -> list[str]:
    """Every option of a parser and of the actions below it."""
    found: list[str] = []
    for action in parser._actions:
        found += action.option_strings
        if isinstance(action, argparse._SubParsersAction):
            found += [option for below in action.choices.values() for option in _options(below)]
    return found


class _HelpAll(argparse.Action):
    """--help-all: the help with every setting that matters to the command."""

    def __call__(self, parser: argparse.ArgumentParser, *_: Any) -> NoReturn:
        parser.usage = parser.format_usage().removeprefix("usage: ").rstrip()
        for action, text in getattr(parser, "settings_help", ()):
            action.help = text
        parser.print_help()
        sys.exit(0)


def add_config_flags(
    parser: argparse.ArgumentParser, sections: Collection[str] = (), shown: Collection[str] = ALWAYS_SHOWN
) -> None:
    """A flag per setting of Config, `--exclude-recent-s` or `--exclude_recent_s`, and --config for a file of them.

    Every command takes every setting; its help shows the `shown` ones, --help-all those of the `sections` (of all
    sections where none is named).
    """
    common = parser.add_argument_group("settings of the recogniser (all of them: --help-all)")
    groups: dict[str, Any] = {}
    for declared in settings_of(Config).values():
        text = f"{declared.doc}; {declared.allowed()}; default {_default(declared)}".replace("%", "%%")
        in_help = declared.name in shown
        matters = not sections or declared.section in ("", *sections)
        if not in_help and declared.section not in groups:
            groups[declared.section] = parser.add_argument_group(f"settings: {declared.section.lower()}")
        group = common if in_help else groups[declared.section]
        flag, dest = "--" + declared.name.replace("_", "-"), f"setting_{declared.name}"
        brief = f"{declared.doc}; default {_default(declared)}".replace("%", "%%")
        action = group.add_argument(
            flag, dest=dest, metavar=_metavar(declared), help=brief if in_help else argparse.SUPPRESS
        )
        if "_" in declared.name:
            parser.add_argument("--" + declared.name, dest=dest, help=argparse.SUPPRESS)
        if isinstance(parser, CommandParser) and (matters or in_help):
            parser.settings_help.append((action, text))
    common.add_argument("--config", metavar="FILE", help="settings from a YAML file, as the node's; flags go before it")
    parser.add_argument("--help-all", action=_HelpAll, nargs=0, help="this help with every setting")


def _default(declared: Setting) -> Any:
    return "the model's" if declared.default == () else declared.default if declared.default != "" else "empty"


def _metavar(declared: Setting) -> str:
    kind = {bool: "{true,false}", int: "N", float: "X", str: "TEXT"}[declared.kind]
    if declared.choices:
        kind = "{" + ",".join(declared.choices) + "}"
    elif declared.unit.isalpha():
        kind = declared.unit.upper()
    return kind + (",..." if declared.many else "")


def config_from(args: argparse.Namespace, **defaults: Any) -> Config:
    """The Config of the parsed flags, over those of --config, over a subcommand's own `defaults`."""
    given = defaults | (settings_file(args.config) if args.config else {})
    for declared in settings_of(Config).values():
        text = getattr(args, f"setting_{declared.name}")
        if text is not None:
            given[declared.name] = parsed(declared, text)
    return Config.make(given.pop("preset", "default"), **given)


def settings_file(path: str | Path) -> dict[str, Any]:
    """The recogniser's settings of a parameter file of the node (`/**: ros__parameters: ...`) or of plain lines.

    Those of the node alone are left out, which is said. Raises ConfigError for a file that is none, and for a name
    close to a setting's.
    """
    import yaml

    try:
        held = yaml.safe_load(Path(path).read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise ConfigError(f"--config {path}: no such file") from None
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        raise ConfigError(f"--config {path}: is no YAML ({' '.join(str(error).split())[:120]})") from None
    if isinstance(held, dict) and len(held) == 1:
        inner = next(iter(held.values()))
        held = inner["ros__parameters"] if isinstance(inner, dict) and "ros__parameters" in inner else held
    if not isinstance(held, dict):
        raise ConfigError(f"--config {path}: holds no settings; allowed: `name: value` lines, or the node's file")
    known = settings_of(Config)
    others = [str(name) for name in held if name not in known]
    for name in others:
        if near := difflib.get_close_matches(name, known, 1, 0.8):
            raise ConfigError(f"--config {path}: {name} is no setting; did you mean {near[0]}?")
    if others:
        print(f"pnv: {path}: no settings of the recogniser, left out: {', '.join(others)}", file=sys.stderr)
    return {name: known[name].check(value) for name, value in held.items() if name in known}


def parsed(declared: Setting, text: str) -> Any:
    """Text of a flag in the setting's type. Raises ConfigError naming the text and what is allowed."""
    if declared.many:
        return tuple(_parsed_one(declared, item.strip()) for item in text.split(",") if item.strip())
    return _parsed_one(declared, text)


def _parsed_one(declared: Setting, text: str) -> Any:
    try:
        return _BOOLEANS[text.lower()] if declared.kind is bool else declared.kind(text)
    except (ValueError, KeyError):
        raise ConfigError(f"{declared.name} = {text!r} is out of range; allowed: {declared.allowed()}") from None


def writable(path: str | Path) -> Path:
    """The path, if a file can be written there. Raises ConfigError before any work is done."""
    target = Path(path)
    if target.is_dir():
        raise ConfigError(f"{path}: is a folder; allowed: a file name")
    if not target.parent.is_dir():
        raise ConfigError(f"{path}: the folder {target.parent} does not exist")
    if not os.access(target if target.exists() else target.parent, os.W_OK):
        raise ConfigError(f"{path}: not writable by this user")
    return target
