"""`pnv fleet`: the places that robots share."""

import argparse
import os
from pathlib import Path

from pnv_cli.common import add_config_flags

ACTIONS = {
    "status": "what the store holds, per robot",
    "push": "a saved map goes up under a robot's name",
    "pull": "a selection comes down as a map that a node loads",
    "query": "where has the fleet seen this image?",
    "forget": "a robot, a session, an area, old or covered places",
    "verify": "read every row and check it",
}


def add_parser(subparsers: "argparse._SubParsersAction[argparse.ArgumentParser]") -> None:
    parser = subparsers.add_parser("fleet", help="places that robots share", allow_abbrev=False)
    actions = parser.add_subparsers(required=True, metavar="ACTION")
    for name, what in ACTIONS.items():
        action = actions.add_parser(name, help=what, description=what, allow_abbrev=False)
        action.set_defaults(run=_act, action=name)
        action.add_argument(
            "--uri",
            default=os.environ.get("PNV_FLEET_URI", ""),
            help="http(s)://HOST:PORT or NAME.db; default PNV_FLEET_URI",
        )
        if name == "push":
            action.add_argument("map", type=Path)
            action.add_argument("--pictures", action="store_true", help="small pictures too, not their features alone")
        if name == "query":
            action.add_argument("image", type=Path)
        if name == "pull":
            action.add_argument("-o", "--output", type=Path, required=True, help="the new map")
        if name != "status" and name != "verify":
            action.add_argument("--robot", default="", help="of this robot")
        if name in ("pull", "forget"):
            action.add_argument("--since", metavar="UTC", help="taken from this moment on, as 2026-05-01T12:00")
            action.add_argument("--session", type=int, help="the session's first stamp in ns, as `status` shows")
            action.add_argument(
                "--area", type=float, nargs=3, metavar=("X", "Y", "R"),
                help="taken in the square X +- R, Y +- R of the robots' poses, in m",
            )  # fmt: skip
        if name == "forget":
            action.add_argument("--older-than", type=float, metavar="DAYS", help="taken longer ago")
            action.add_argument("--covered", type=float, metavar="SIMILARITY", help="a newer place is as similar")
            action.add_argument("--all", action="store_true", help="everything of this model")
        add_config_flags(action)


def _act(args: argparse.Namespace) -> int:
    from pnv_cli.fleet_actions import ACTIONS as DONE  # numpy, the describer and the store: not for --help

    return DONE[args.action](args)
