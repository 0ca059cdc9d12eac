"""pnv calibrate --images DIR | --video FILE | --bag DIR  -o MODEL.safetensors"""

import argparse

from pnv_cli.common import add_config_flags, config_from, writable
from pnv_cli.sources import add_source_flags, source_of
from pnv_core.errors import ConfigError, PnvError

_LEAST = 30  # examples of either kind below which a fit says little


def add_parser(subparsers: argparse._SubParsersAction) -> None:
    parser = subparsers.add_parser(
        "calibrate",
        help="fit the score to your own sequence",
        description="Writes a copy of the model whose scores are probabilities on sequences like this one. Truth comes "
        "from --poses, from --matches, or by default from time: images close in time show one place, those far apart "
        "another.",
        allow_abbrev=False,
    )
    add_source_flags(parser)
    truth = parser.add_mutually_exclusive_group()
    truth.add_argument(
        "--poses",
        metavar="FILE",
        help="csv (frame or timestamp, x, y and, if known, z, yaw or qx,qy,qz,qw), TUM, EuRoC",
    )
    truth.add_argument("--matches", metavar="CSV", help="columns query,true_refs; references separated by ;")
    parser.add_argument("--radius-m", type=float, default=2.0, help="with --poses: one place within; default 2")
    parser.add_argument("--heading-deg", type=float, default=30.0, help="with --poses: one view within; default 30")
    parser.add_argument("--near-s", type=float, default=2.0, help="from time: one place within; default 2")
    parser.add_argument("--far-s", type=float, default=30.0, help="from time: another place beyond; default 30")
    parser.add_argument("--precision", type=float, default=0.99, help="wished share of true closures; default 0.99")
    parser.add_argument("-o", "--output", required=True, metavar="MODEL", help="the calibrated model")
    add_config_flags(parser, sections=("Describing", "Keyframes", "Retrieval", "Re-ranking"))
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    from pnv_core.describe.describer import describer_from
    from pnv_core.describe.model_files import save_model
    from pnv_lab.calibrating import (
        calibrate,
        cross_check,
        gather_examples,
        truth_of_matches,
        truth_of_poses,
        truth_of_time,
        without_unlabelled_loops,
    )

    output = writable(args.output)
    if not 0 < args.near_s < args.far_s:
        raise ConfigError(f"--near-s {args.near_s} --far-s {args.far_s}; allowed: 0 < near < far")
    if not (args.radius_m > 0 and args.heading_deg > 0 and 0 < args.precision <= 1):
        raise ConfigError("--radius-m, --heading-deg and --precision; allowed: above 0, precision at most 1")
    describer = describer_from(config_from(args))
    by_time = not (args.poses or args.matches)
    if args.poses:
        truth = truth_of_poses(args.poses, args.radius_m, args.heading_deg)
    elif args.matches:
        truth = truth_of_matches(args.matches)
    else:
        truth = truth_of_time(args.near_s, args.far_s)
    # from time, the neighbours are what is true: they must be candidates
    recent_s = 0.0 if by_time else describer.config.exclude_recent_s
    found = gather_examples(describer, source_of(args).frames, truth, recent_s)
    if by_time:
        found = without_unlabelled_loops(found)
    true, false = int(found.true.sum()), int((~found.true).sum())
    if min(true, false) < _LEAST:
        raise PnvError(
            f"{true} true and {false} false candidates found; allowed: at least {_LEAST} of each "
            "(a longer sequence, other --near-s and --far-s, or --poses)"
        )
    calibration = calibrate(found, describer, f"pnv calibrate, {true} true and {false} false candidates")
    save_model(describer.model.with_info(calibration=calibration.to_json()), output)
    print(f"{true} true and {false} false candidates -> {output}")
    checked = cross_check(found, describer)
    if checked is not None:
        diagram = checked.diagram
        print("score  share true  candidates   (each quarter of the sequence judged by the other three)")
        for score, share, count in zip(diagram.score, diagram.share_true, diagram.count, strict=True):
            print(f"{score:5.2f}  {share:10.2f}  {count:10d}")
        print(f"expected calibration error {diagram.expected_error:.3f}")
        threshold = checked.threshold(args.precision)
        reached = f"--accept-score {threshold:.3f}" if threshold <= 1 else "no threshold"
        print(f"precision {args.precision:g} of single candidates: {reached}")
    return 0
