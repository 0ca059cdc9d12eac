"""Flags every subcommand shares, generated from Config, and reading images from files."""

import argparse
from pathlib import Path
from typing import Any

from pnv_core.config import Config
from pnv_core.errors import ConfigError
from pnv_core.settings import Setting, settings_of

_BOOLEANS = {"true": True, "1": True, "yes": True, "false": False, "0": False, "no": False}


def add_config_flags(parser: argparse.ArgumentParser) -> None:
    """A flag per setting of Config, `--exclude-recent-s` or `--exclude_recent_s`."""
    group = parser.add_argument_group("settings")
    for declared in settings_of(Config).values():
        dashed = "--" + declared.name.replace("_", "-")
        names = [dashed] if "_" not in declared.name else [dashed, "--" + declared.name]
        default = declared.default if declared.default != () else "the model's"
        group.add_argument(
            *names,
            dest=f"setting_{declared.name}",
            metavar=declared.kind.__name__.upper() + (",..." if declared.many else ""),
            help=f"{declared.doc}; {declared.allowed()}; default {default}".replace("%", "%%"),
        )


def config_from(args: argparse.Namespace, **defaults: Any) -> Config:
    """The Config of the parsed flags; `defaults` are a subcommand's own, under the user's."""
    given = dict(defaults)
    for declared in settings_of(Config).values():
        text = getattr(args, f"setting_{declared.name}")
        if text is not None:
            given[declared.name] = parsed(declared, text)
    return Config.make(given.pop("preset", "default"), **given)


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
    import os

    if not os.access(target if target.exists() else target.parent, os.W_OK):
        raise ConfigError(f"{path}: not writable by this user")
    return target
