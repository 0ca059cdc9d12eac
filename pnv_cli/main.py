"""`pnv`: the command line of the recogniser."""

import argparse
import os
import shlex
import sys
from collections.abc import Sequence
from importlib import import_module
from pathlib import Path

from pnv_cli.common import CommandParser, hint
from pnv_core.errors import ConfigError, PnvError, one_line, shown

COMMANDS = {
    "run": "loop closures of a folder of images, a video or a bag, with a report",
    "bag": "what the node would publish of a bag, as a bag to play beside it",
    "match": "do two images show the same place?",
    "map": "inspect, check, merge, thin out, recover and export saved maps",
    "fleet": "places that robots share: status, push, pull, query, forget, verify",
    "doctor": "check this machine, and say what to do",
    "bench": "how fast this machine is, and which settings keep up with a rate",
    "weights": "published models: list, fetch, verify",
    "describe": "the descriptors of an image, as arrays",
    "recall": "recall@1, 5 and 10 over two folders of images",
    "evaluate": "recall, precision and cost of many methods over data sets, with a report",
    "calibrate": "fit the score to your own sequence",
    "fit": "adapt vocabulary and projections to your own images",
    "train": "train a model",
}  # a command's module, which may take long to import, is loaded when the command is given


def help_text() -> str:
    """What `pnv --help` prints, without loading any command."""
    lines = [f"  {name:<10}{what}" for name, what in COMMANDS.items()]
    return "\n".join(
        [
            "usage: pnv COMMAND ...   (pnv COMMAND --help says more)\n",
            "Visual place recognition and loop closure. First: pnv run PATH\n",
            *lines,
            "\n  --help    this list\n  --version",
        ]
    )


def command_parser(name: str) -> CommandParser:
    """The parser of one command. Imports its module."""
    subparsers = argparse.ArgumentParser(prog="pnv").add_subparsers(parser_class=CommandParser)
    import_module(f"pnv_cli.{name}").add_parser(subparsers)
    parser = subparsers.choices[name]
    assert isinstance(parser, CommandParser)
    return parser


def _require_usable(args: argparse.Namespace) -> None:
    """Refuse numbers that are not finite or beyond 64 bits, and names that no file can have, whatever the flag."""
    for name, given in vars(args).items():
        for value in given if isinstance(given, list) else [given]:
            flag = "--" + name.removeprefix("setting_").replace("_", "-")
            if isinstance(value, int | float) and not abs(value) < 2**63:
                raise ConfigError(f"{flag} {shown(value)}; allowed: a finite number of 64 bits")
            if isinstance(value, str | Path) and "\0" in str(value):
                raise ConfigError(f"{flag} {shown(str(value))}; allowed: text without NUL")


def main(argv: Sequence[str] | None = None) -> int:
    """Run a subcommand. 0 done, 2 unusable input with one line on stderr, 130 interrupted."""
    given = list(sys.argv[1:] if argv is None else argv)
    if not given or given[0] in ("-h", "--help", "help"):
        print(help_text(), file=sys.stdout if given else sys.stderr)
        return 0 if given else 2
    if given[0] == "--version":
        import pnv_core

        print(f"pnv {pnv_core.__version__}")
        return 0
    if given[0] not in COMMANDS:
        allowed = hint(given[0], COMMANDS) or f"; allowed: {', '.join(COMMANDS)}"
        print(f"pnv: no command {given[0]!r}{allowed}", file=sys.stderr)
        return 2
    parser = command_parser(given[0])
    args = parser.parse_command(given[1:])
    args.command_line = shlex.join(["pnv", *given])  # reports say how to repeat them
    try:
        _require_usable(args)
        return int(args.run(args))
    except PnvError as error:
        print(f"pnv: {error}", file=sys.stderr)
        return 2
    except BrokenPipeError:  # who read the output has seen enough
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())  # or Python tries once more at its end
        return 0
    except OSError as error:  # a path that cannot be read or written: the system's words name it
        print(one_line(f"pnv: {error.strerror or error}: {error.filename or ''}"), file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print("pnv: interrupted", file=sys.stderr)
        return 130


if __name__ == "__main__":
    sys.exit(main())
