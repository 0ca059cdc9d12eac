"""pnv recall --queries DIR --references DIR --matches CSV"""

import argparse
import json
import sys
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from pnv_cli.common import add_config_flags, config_from
from pnv_cli.progress import bar
from pnv_core.errors import ConfigError

RECALLS = (1, 5, 10)


def add_parser(subparsers: Any) -> None:
    parser = subparsers.add_parser(
        "recall",
        help="recall@1, 5 and 10 over two folders of images",
        description="Recall over two folders of images, before and after re-ranking. The last line on stdout is JSON.",
        allow_abbrev=False,
    )
    parser.add_argument("--queries", required=True, metavar="DIR", help="images to ask for")
    parser.add_argument("--references", required=True, metavar="DIR", help="images to find")
    parser.add_argument("--matches", required=True, metavar="CSV", help="query,true_refs; references separated by ;")
    add_extraction_flags(parser)
    add_config_flags(parser, sections=("Describing", "Retrieval", "Re-ranking"))
    parser.set_defaults(run=run)


def add_extraction_flags(parser: argparse.ArgumentParser) -> None:
    """Flags of every command that describes whole data sets."""
    parser.add_argument("--cache", metavar="DIR", help="folder of described images; default: in the user's cache")
    parser.add_argument("--workers", type=int, default=1, metavar="N", help="processes describing images (default 1)")
    parser.add_argument(
        "--dask",
        nargs="?",
        const="local",
        metavar="ADDRESS",
        help="describe on a Dask cluster, by default of this machine",
    )


def checked_extraction(args: argparse.Namespace) -> Path:
    """The cache folder. Raises ConfigError for flags out of range."""
    from pnv_lab.evaluation.store import default_cache

    if not 1 <= args.workers <= 256:
        raise ConfigError(f"--workers {args.workers} is out of range; allowed: 1 to 256")
    if args.cache is None:
        return default_cache()
    folder = Path(args.cache)
    if folder.exists() and not folder.is_dir():
        raise ConfigError(f"--cache {folder}: is a file; allowed: a folder")
    folder.mkdir(parents=True, exist_ok=True)
    return folder


def progress(items: Iterable[Any], count: int, what: str) -> Iterable[Any]:
    """The items with a bar on stderr that says how much time is left."""
    return bar(items, total=count, desc=what, unit="item")


def run(args: argparse.Namespace) -> int:
    from pnv_lab.evaluation.datasets.pairs import pairs_dataset
    from pnv_lab.evaluation.evaluate import Evaluation
    from pnv_lab.evaluation.methods import configured_method, global_method
    from pnv_lab.evaluation.metrics import recall_at

    config = config_from(args)
    cache = checked_extraction(args)
    dataset = pairs_dataset(args.queries, args.references, args.matches)
    for note in dataset.notes:
        print(f"pnv: {note}", file=sys.stderr)
    counted = [i for i, true in enumerate(dataset.truth) if len(true)]
    dataset = dataset.take(counted) if counted else dataset
    evaluation = Evaluation(config, cache, progress, workers=args.workers, dask=args.dask, depth=max(RECALLS))
    before, after = evaluation.run(dataset, [global_method(), configured_method()])

    def figures(result: Any) -> dict[str, float | None]:
        return {f"recall@{n}": round(recall_at(result.hits, n), 6) if len(result.hits) else None for n in RECALLS}

    print(f"{'':20}" + "".join(f"{f'R@{n}':>8}" for n in RECALLS))
    for result, label in ((before, "before re-ranking"), (after, "after re-ranking")):
        print(f"{label:20}" + "".join(f"{100 * recall_at(result.hits, n):8.1f}" for n in RECALLS))
    print(json.dumps(figures(after) | {"queries": len(after.hits), "global": figures(before)}))
    return 0
