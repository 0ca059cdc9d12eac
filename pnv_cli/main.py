"""`pnv`: the command line of the recogniser."""

import argparse
import sys
from collections.abc import Sequence
from importlib import import_module

from pnv_core.errors import PnvError

COMMANDS = (
    "describe",
    "match",
    "run",
    "recall",
    "evaluate",
    "calibrate",
    "fit",
    "train",
    "weights",
    "map",
    "doctor",
    "bench",
)


def main(argv: Sequence[str] | None = None) -> int:
    """Run a subcommand. 0 done, 2 unusable input with one line on stderr, 130 interrupted."""
    parser = argparse.ArgumentParser(
        prog="pnv", description="Visual place recognition with Patch-NetVLAD.", allow_abbrev=False
    )
    subparsers = parser.add_subparsers(required=True, metavar="COMMAND")
    given = list(sys.argv[1:] if argv is None else argv)
    for name in COMMANDS if not given or given[0] not in COMMANDS else given[:1]:  # importing torch takes seconds
        import_module(f"pnv_cli.{name}").add_parser(subparsers)
    args = parser.parse_args(argv)
    try:
        return int(args.run(args))
    except PnvError as error:
        print(f"pnv: {error}", file=sys.stderr)
        return 2
    except OSError as error:  # a path that cannot be read or written: the system's words name it
        print(f"pnv: {error.strerror or error}: {error.filename or ''}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print("pnv: interrupted", file=sys.stderr)
        return 130


if __name__ == "__main__":
    sys.exit(main())
