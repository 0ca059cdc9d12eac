"""pnv match A B [--json] [--draw OUT.png]"""

import argparse
import json
from typing import TYPE_CHECKING, Any

from pnv_cli.common import add_config_flags, config_from, writable
from pnv_core.errors import ConfigError

if TYPE_CHECKING:
    from pnv_core.describe.describer import Describer
    from pnv_core.types import LoopClosure

PICTURES = (".png", ".jpg", ".jpeg")


def add_parser(subparsers: argparse._SubParsersAction) -> None:
    parser = subparsers.add_parser(
        "match", description="Do two images show the same place? The probability first, then what speaks for it."
    )
    parser.add_argument("query", metavar="A", help="an image")
    parser.add_argument("reference", metavar="B", help="another image")
    parser.add_argument("--json", action="store_true", help="one JSON object instead of a table")
    parser.add_argument("--draw", metavar="OUT.png", help="picture of both images and their patch correspondences")
    add_config_flags(parser, ("Describing", "Re-ranking", "Decision"), ("weights", "preset", "device", "accept_score"))
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    import cv2

    from pnv_core.describe.describer import describer_from
    from pnv_core.drawing import draw_match
    from pnv_core.files import atomic_write
    from pnv_core.images import read_image
    from pnv_core.verify.reranker import Reranker
    from pnv_core.verify.spatial import ransac_score, rapid_spatial_score

    picture = writable(args.draw) if args.draw else None
    if picture and picture.suffix.lower() not in PICTURES:
        raise ConfigError(f"--draw {picture}: is no picture; allowed: {', '.join(PICTURES)}")
    describer = describer_from(config_from(args))
    images = read_image(args.query), read_image(args.reference)
    query, reference = (describer.describe(image) for image in images)
    result = Reranker(describer.config).score(query, reference)
    sizes = []
    for q, r, found in zip(query.patches, reference.patches, result.matches, strict=True):
        pairs = found.query, found.reference
        ransac, inlier = ransac_score(q, r, pairs)
        sizes.append(
            {
                "patch_size": q.size,
                "matches": len(found.query),
                "inliers": int(inlier.sum()),
                "ransac": ransac,
                "rapid": rapid_spatial_score(q, r, pairs),
            }
        )
    closure = _alone(describer, *images)
    report = {
        "probability": closure.score,
        "same_place": closure.accepted,
        "reason": str(closure.reason),
        "score": result.score,
        "scorer": describer.config.scorer,
        "similarity": float(query.global_vector @ reference.global_vector),
        "local_inliers": closure.evidence.local_inliers if closure.evidence else -1,
        "match_confidence": closure.evidence.match_confidence if closure.evidence else -1.0,
        "sizes": sizes,
    }
    if picture:
        caption = f"probability {closure.score:.2f}"
        image = draw_match(images[0], images[1], result.matches, describer.image_size, caption)
        _, encoded = cv2.imencode(picture.suffix, cv2.cvtColor(image, cv2.COLOR_RGB2BGR))
        with atomic_write(picture) as file:
            file.write(encoded.tobytes())
    print(json.dumps(report) if args.json else _table(report, describer.config.accept_score))
    return 0


def _alone(describer: "Describer", query: Any, reference: Any) -> "LoopClosure":
    """What the recogniser decides of the pair, with no other images about."""
    from pnv_core.recognizer import PlaceRecognizer
    from pnv_core.types import Frame

    recognizer = PlaceRecognizer(describer)
    recognizer.change(min_interval_s=0.0, min_change=0.0, exclude_recent_s=0.0, consistency=0)
    recognizer.process(Frame(0, "B", reference))
    return recognizer.process(Frame(10**9, "A", query))[0]


def _table(report: dict[str, Any], least: float) -> str:
    verdict = "yes" if report["same_place"] else f"no ({report['reason']})"
    lines = [
        f"same place  {verdict}: probability {report['probability']:.2f}, accepted from {least:g}; judged by these two "
        "images alone",
        f"similarity  {report['similarity']:.4f}   cosine of the global vectors",
        f"spatial     {report['score']:.4f}   {report['scorer']}: how much of the patches agrees on one geometry; "
        "no probability",
    ]
    if report["match_confidence"] >= 0:
        told = "sum of the probabilities of LighterGlue's matches: a closer look"
        lines.append(f"closer      {report['match_confidence']:<6.1f}   {told}")
    if report["local_inliers"] >= 0:
        lines.append(f"local       {report['local_inliers']:<6}   small features on one epipolar geometry")
    lines.append("\npatch size  matches  inliers  ransac   rapid")
    for size in report["sizes"]:
        lines.append("{patch_size:>10}  {matches:>7}  {inliers:>7}  {ransac:.4f}  {rapid:.4f}".format(**size))
    return "\n".join(lines)
