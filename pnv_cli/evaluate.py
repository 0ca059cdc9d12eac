"""pnv evaluate --dataset KIND --root DIR... --method NAME[,NAME...] [--out DIR]"""

import argparse
import json
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pnv_cli.common import add_config_flags, config_from, writable
from pnv_cli.recall import add_extraction_flags, checked_extraction, progress
from pnv_core.config import Config
from pnv_core.errors import ConfigError
from pnv_core.files import atomic_write

if TYPE_CHECKING:
    from pnv_lab.evaluation.datasets import Dataset, SequenceRule
    from pnv_lab.evaluation.evaluate import Evaluation, MethodResult
    from pnv_lab.evaluation.summary import Figures

_FORMATS = ("results.csv", "results.json", "tables.txt")


def add_parser(subparsers: Any) -> None:
    parser = subparsers.add_parser(
        "evaluate",
        help="recall, precision and cost of methods over data sets, with a report",
        description="Evaluate place recognition methods over data sets in their published layouts.",
        allow_abbrev=False,
    )
    parser.add_argument("--dataset", default="folder", metavar="KIND", help="layout; --list names all (default folder)")
    parser.add_argument("--root", nargs="+", metavar="DIR", help="the data set's folder; several are several data sets")
    parser.add_argument("--split", default="", help="part of the data set, as its layout has it")
    parser.add_argument("--method", default="variants", metavar="NAME,...", help="methods or groups (default variants)")
    parser.add_argument("--list", action="store_true", help="print data set layouts and methods, then stop")
    parser.add_argument("--queries", type=int, default=0, metavar="N", help="at most N queries of each set; 0 = all")
    parser.add_argument("--radius-m", type=float, default=5.0, help="sequences: same place within (default 5)")
    parser.add_argument("--angle-deg", type=float, default=45.0, help="sequences: turned by at most (default 45)")
    parser.add_argument("--image-topic", metavar="TOPIC", help="bag: the images; by default the only image topic")
    parser.add_argument("--pose-topic", metavar="TOPIC", help="bag: the ground truth; by default the only pose topic")
    parser.add_argument("--every-s", type=float, default=0.5, help="bag: seconds between frames (default 0.5)")
    parser.add_argument("--grid", metavar="SIZES", help="search patch sizes and weights among these, such as 2,3,5,8")
    parser.add_argument("--out", metavar="DIR", help=f"write {', '.join(_FORMATS)}, report.html and submissions here")
    parser.add_argument("--report", metavar="FILE.html", help="write the report here")
    add_extraction_flags(parser)
    add_config_flags(parser, sections=("Describing", "Retrieval", "Re-ranking"))
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    if args.list:
        return _list()
    if not args.root:
        raise ConfigError("--root is missing; allowed: the folder of a data set")
    from pnv_lab.evaluation.evaluate import Evaluation
    from pnv_lab.evaluation.grid import grid_search
    from pnv_lab.evaluation.methods import parse_methods
    from pnv_lab.evaluation.summary import detail_table, paper_table

    report = writable(args.report) if args.report else None
    out = _out_folder(args.out)
    config, cache = config_from(args), checked_extraction(args)
    methods = parse_methods(args.method)
    sizes = _grid_sizes(args.grid)
    datasets = [_opened(args, config, cache, Path(root)) for root in args.root]
    evaluation = Evaluation(config, cache, progress, args.workers, args.dask)
    if sizes:
        for dataset in datasets:
            _print_grid(dataset.name, grid_search(evaluation, dataset, sizes, config.scorer))
        return 0
    results = [evaluation.run(dataset, methods) for dataset in datasets]
    figures = [_figures(of_one) for of_one in results]
    every = [f for of_one in figures for f in of_one]
    tables = f"{paper_table(every)}\n\n{detail_table(every)}"
    print(tables)
    if out:
        _write_all(out, every, tables, results)
    target = report or (out / "report.html" if out else None)
    if target:
        _write_report(target, evaluation, results, figures, args)
        print(f"report: {target}")
    return 0


def _list() -> int:
    from pnv_lab.evaluation.datasets import KINDS
    from pnv_lab.evaluation.methods import GROUPS, METHODS

    print("data set layouts: " + ", ".join((*KINDS, "bag")))
    for name, method in METHODS.items():
        print(f"  {name:22} {method.label}")
    for name, members in GROUPS.items():
        print(f"  {name:22} = {', '.join(members)}")
    print("after a name: :DIM (leading dimensions of the PCA), @WEIGHTS (another model), [sizes=2+5;weights=0.6+0.4]")
    return 0


def _opened(args: argparse.Namespace, config: Config, cache: Path, root: Path) -> "Dataset":
    from pnv_lab.evaluation.datasets import SequenceRule, open_dataset

    rule = SequenceRule(args.radius_m, args.angle_deg, config.exclude_recent_s)
    for name, value in (("--radius-m", args.radius_m), ("--angle-deg", args.angle_deg), ("--every-s", args.every_s)):
        if not 0 < value < 1e6:
            raise ConfigError(f"{name} {value:g} is out of range; allowed: more than 0")
    if args.queries < 0:
        raise ConfigError(f"--queries {args.queries} is out of range; allowed: 0 (all) or more")
    if args.dataset == "bag":
        dataset = _bag(args, cache, root, rule)
    else:
        dataset = open_dataset(args.dataset, root, args.split, rule)
    for note in dataset.notes:
        print(f"pnv: {dataset.name}: {note}", file=sys.stderr)
    dataset = dataset.first(args.queries)
    if not dataset.answerable:
        why = f": {rule.words()}" if dataset.sequence else ""
        print(f"pnv: {dataset.name}: none of {len(dataset.queries)} queries has a true reference{why}", file=sys.stderr)
    return dataset


def _bag(args: argparse.Namespace, cache: Path, root: Path, rule: "SequenceRule") -> "Dataset":
    from pnv_cli.bag_frames import unpacked
    from pnv_lab.evaluation.datasets.sequences import poses_csv

    return poses_csv(unpacked(root, cache / "bags", args.image_topic, args.pose_topic, args.every_s, progress), rule)


def _grid_sizes(text: str | None) -> list[int]:
    if text is None:
        return []
    try:
        sizes = sorted({int(s) for s in text.split(",")})
    except ValueError:
        sizes = []
    if not sizes or sizes[0] < 1:
        raise ConfigError(f"--grid {text!r}; allowed: patch sizes separated by commas, such as 2,3,5,8")
    return sizes


def _print_grid(name: str, points: Sequence[Any]) -> None:
    print(f"{name}: {len(points)} settings, best first")
    print(f"{'patch sizes':<14}{'weights':<22}{'R@1':>7}{'R@5':>7}{'MRR':>7}")
    for p in points[:15]:
        weights = " ".join(f"{w:.2f}" for w in p.weights)
        recalls = f"{100 * p.recall_1:>7.1f}{100 * p.recall_5:>7.1f}{p.mean_reciprocal_rank:>7.3f}"
        print(f"{' '.join(map(str, p.sizes)):<14}{weights:<22}{recalls}")
    best = points[0]
    sizes = ",".join(map(str, best.sizes))
    print(f"use: --patch-sizes {sizes} --patch-weights {','.join(f'{w:.2f}' for w in best.weights)}")


def _figures(results: Sequence["MethodResult"]) -> list["Figures"]:
    from pnv_lab.evaluation.summary import figures_of

    return [f for result in results for f in figures_of(result)]


def _out_folder(text: str | None) -> Path | None:
    if text is None:
        return None
    folder = Path(text)
    if folder.exists() and not folder.is_dir():
        raise ConfigError(f"--out {folder}: is a file; allowed: a folder")
    folder.mkdir(parents=True, exist_ok=True)
    return folder


def _write_all(
    out: Path, figures: Sequence["Figures"], tables: str, results: Sequence[Sequence["MethodResult"]]
) -> None:
    from pnv_lab.evaluation.datasets.seasons import write_submission
    from pnv_lab.evaluation.summary import csv_text

    contents = {
        "results.csv": csv_text(figures),
        "results.json": json.dumps([f.as_dict() for f in figures], indent=1) + "\n",
        "tables.txt": tables + "\n",
    }
    for name, text in contents.items():
        with atomic_write(out / name) as file:
            file.write(text.encode())
    for result in (r for of_one in results for r in of_one if r.dataset.names):
        best = [int(k.references[0]) if len(k.references) else -1 for k in result.rankings]
        safe = "".join(c if c.isalnum() or c in "-_." else "_" for c in result.method.name)
        write_submission(out / f"{result.dataset.name}_eval_{safe}.txt", result.dataset, best)


def _write_report(
    target: Path,
    evaluation: "Evaluation",
    results: Sequence[Sequence["MethodResult"]],
    figures: Sequence[Sequence["Figures"]],
    args: argparse.Namespace,
) -> None:
    from pnv_lab.evaluation.machine import about
    from pnv_lab.evaluation.report import Chapter, evaluation_report

    chapters = [Chapter(r, f) for r, f in zip(results, figures, strict=True)]
    head = about(args.command_line, evaluation.config, evaluation.completed(evaluation.config))
    with atomic_write(target) as file:
        file.write(evaluation_report(evaluation, chapters, head).encode())
