"""pnv match A B [--json] [--draw OUT.png]"""

import argparse
import json

import cv2

from pnv_cli.common import add_config_flags, config_from, writable
from pnv_core.describe.describer import describer_from
from pnv_core.drawing import draw_match
from pnv_core.errors import ConfigError
from pnv_core.files import atomic_write
from pnv_core.images import read_image
from pnv_core.verify.reranker import Reranker
from pnv_core.verify.spatial import ransac_score, rapid_spatial_score

PICTURES = (".png", ".jpg", ".jpeg")


def add_parser(subparsers: argparse._SubParsersAction) -> None:
    parser = subparsers.add_parser("match", help="how well two images match", allow_abbrev=False)
    parser.add_argument("query")
    parser.add_argument("reference")
    parser.add_argument("--json", action="store_true", help="one JSON object instead of a table")
    parser.add_argument("--draw", metavar="OUT.png", help="picture of both images and their patch correspondences")
    add_config_flags(parser)
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
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
    similarity = float(query.global_vector @ reference.global_vector)
    report = {"score": result.score, "scorer": describer.config.scorer, "similarity": similarity, "sizes": sizes}
    if picture:
        caption = f"score {result.score:.3f}  similarity {similarity:.3f}"
        image = draw_match(*images, result.matches, describer.image_size, caption)
        _, encoded = cv2.imencode(picture.suffix, cv2.cvtColor(image, cv2.COLOR_RGB2BGR))
        with atomic_write(picture) as file:
            file.write(encoded.tobytes())
    print(json.dumps(report) if args.json else _table(report))
    return 0


def _table(report: dict) -> str:
    lines = [f"score {report['score']:.4f} ({report['scorer']})   similarity {report['similarity']:.4f}"]
    lines.append("patch size  matches  inliers  ransac   rapid")
    for size in report["sizes"]:
        lines.append("{patch_size:>10}  {matches:>7}  {inliers:>7}  {ransac:.4f}  {rapid:.4f}".format(**size))
    return "\n".join(lines)
