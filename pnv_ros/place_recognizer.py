"""The executable `place_recognizer`; see running.py. Nothing else is imported before a signal has its meaning."""

import signal
import sys


def main(args: list[str] | None = None) -> int:
    """Exit status of the node. Until the node hears signals itself, one ends the process at once and in silence."""
    # Python's own answer to SIGINT is an exception, which is a traceback in an import, or is swallowed by it for good.
    signal.signal(signal.SIGINT, signal.SIG_DFL)
    from pnv_ros.running import main as run

    return run(args)


if __name__ == "__main__":
    sys.exit(main())
