"""What each action of `pnv fleet` does. Exit status as returned."""

import argparse
import math
import time
from datetime import datetime, timezone
from pathlib import Path

import numpy as np

from pnv_cli.common import config_from
from pnv_core.describe.describer import Describer, describer_from
from pnv_core.errors import ConfigError
from pnv_core.images import read_image
from pnv_core.types import ImageRef, PlaceDescriptor, Query
from pnv_fleet import maps
from pnv_fleet.answers import Answers
from pnv_fleet.errors import FleetError
from pnv_fleet.places import descriptor_of, layouts_of, parts_of, robot_name, without_picture
from pnv_fleet.store import Access, PlaceStore


def _opened(args: argparse.Namespace, create: bool = False) -> tuple[PlaceStore, Describer, PlaceDescriptor]:
    if not args.uri:
        raise ConfigError("no --uri given; allowed: http(s)://HOST:PORT, NAME.db, or PNV_FLEET_URI in the environment")
    if args.uri.endswith(".db") and not args.uri.startswith("http") and not create and not Path(args.uri).exists():
        raise FleetError(f"{args.uri} does not exist; allowed: a store that `pnv fleet push` or a node made")
    describer = describer_from(config_from(args))
    width, height = describer.image_size
    like = describer.describe(np.zeros((height, width, 3), np.uint8))
    size = (len(like.global_vector), parts_of(layouts_of(like))) if create else ()
    return PlaceStore(args.uri, describer.map_fingerprint, Access.from_environment(), *size), describer, like


def _where(args: argparse.Namespace) -> str:
    """The expression of the flags; empty for none of them."""
    terms = []
    if args.robot:
        terms.append(f'robot == "{robot_name(args.robot)}"')
    if args.session is not None:
        if not 0 <= args.session < 2**63:
            raise ConfigError(f"--session {args.session}; allowed: a stamp in ns, as `pnv fleet status` shows")
        terms.append(f"session == {args.session}")
    if args.since:
        try:
            moment = datetime.fromisoformat(args.since)
            utc = moment if moment.tzinfo else moment.replace(tzinfo=timezone.utc)
            since = int(utc.timestamp() * 1e9)
        except (ValueError, OverflowError):
            since = -1
        if since < 0:
            raise ConfigError(f"--since {args.since}; allowed: a moment since 1970 as 2026-05-01T12:00 (UTC)")
        terms.append(f"stamp_ns >= {since}")
    if args.area:
        x, y, radius = args.area
        if not all(map(math.isfinite, args.area)) or radius < 0:
            raise ConfigError(f"--area {x:g} {y:g} {radius:g}; allowed: X Y R in metres")
        terms.append(f"posed == true and x >= {x - radius!r} and x <= {x + radius!r}")
        terms.append(f"y >= {y - radius!r} and y <= {y + radius!r}")
    if getattr(args, "older_than", None) is not None:
        if not 0 <= args.older_than < 1e6:
            raise ConfigError(f"--older-than {args.older_than:g}; allowed: 0 to 1000000 days")
        terms.append(f"stamp_ns < {int((time.time() - args.older_than * 86400) * 1e9)}")
    return " and ".join(terms)


def _status(args: argparse.Namespace) -> int:
    store, _, _ = _opened(args)
    print(f"{store.uri}: {store.version()}, collection {store.collection}, {store.count()} places")
    print(f"{'robot':<24}{'session':>20}{'places':>9}  first and last (UTC)")
    found = maps.sessions(store)
    for robot in dict.fromkeys(robot for robot, _ in found):
        own = {session: what for (of, session), what in found.items() if of == robot}
        for session, (count, first, last) in own.items():
            span = " to ".join(datetime.fromtimestamp(s / 1e9, timezone.utc).strftime("%F %T") for s in (first, last))
            print(f"{robot:<24}{session:>20}{count:>9}  {span}")
        if len(own) > 1:
            print(f"{robot:<24}{f'{len(own)} sessions':>20}{sum(count for count, _, _ in own.values()):>9}")
    return 0


def _push(args: argparse.Namespace) -> int:
    if not args.robot:
        raise ConfigError("push needs --robot NAME, whose map it is")
    store, describer, like = _opened(args, create=True)
    count = maps.push(store, args.map, args.robot, describer.map_fingerprint, like, args.pictures)
    print(f"{store.uri}: {count} keyframes of {args.robot}")
    return 0


def _pull(args: argparse.Namespace) -> int:
    store, describer, like = _opened(args)
    manifest = maps.pull(store, _where(args), args.output, describer.map_fingerprint, like, print)
    print(f"{args.output}: {manifest.keyframes} keyframes in {len(manifest.sessions)} sessions")
    return 0


def _query(args: argparse.Namespace) -> int:
    store, describer, like = _opened(args)
    rgb = read_image(args.image)
    answers = Answers(describer.config.replace(consistency=0), describer.model.info.calibration, like)
    seen = describer.describe(rgb)
    seen = PlaceDescriptor(seen.global_vector, seen.patches, seen.texture, answers.keep(rgb))
    where = f'robot == "{robot_name(args.robot)}"' if args.robot else ""
    found = answers.to(Query(ImageRef(-1, 0, "query"), without_picture(seen), 1.0), store, where)
    for line in answers.refused:
        print(f"refused {line}")
    print(f"{'robot':<24}{'stamp':>22}  {'score':>6}{'similarity':>12}  verdict")
    for c in found:
        verdict = "accepted" if c.accepted else c.reason
        print(f"{c.match.robot:<24}{c.match.stamp_ns / 1e9:>22.9f}  {c.score:>6.3f}{c.similarity:>12.3f}  {verdict}")
    return 0


def _forget(args: argparse.Namespace) -> int:
    where = _where(args)
    if not where and args.covered is None and not args.all:
        raise ConfigError("nothing is named to forget; allowed: --robot, --session, --since, --area, --older-than, "
                          "--covered or --all")  # fmt: skip
    if args.covered is not None and not -1 <= args.covered <= 1:
        raise ConfigError(f"--covered {args.covered:g}; allowed: a similarity, -1 to 1")
    store, _, _ = _opened(args)
    count = maps.thin(store, args.covered, where) if args.covered is not None else store.forget(where or 'key != ""')
    print(f"{store.uri}: forgot {count} places, {store.count()} are left")
    return 0


def _verify(args: argparse.Namespace) -> int:
    store, _, like = _opened(args)
    whole = damaged = 0
    for place in store.scan(views=True):
        try:
            if isinstance(place, str):
                raise FleetError(place)
            descriptor_of(place, like)
            whole += 1
        except FleetError as error:
            damaged += 1
            print(error)
    print(f"{store.uri}: {whole} places are whole, {damaged} are not")
    return 2 if damaged else 0


ACTIONS = {
    "status": _status, "push": _push, "pull": _pull, "query": _query, "forget": _forget, "verify": _verify,
}  # fmt: skip
