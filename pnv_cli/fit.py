"""`pnv fit`: a model adapted to one's own images, without training."""

import argparse
import random
from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pnv_cli.common import writable
from pnv_cli.progress import bar
from pnv_core.errors import ConfigError

if TYPE_CHECKING:
    from pnv_core.describe.model_files import Model
    from pnv_lab.fit import FitOptions

_UNTRAINED = ("rootsift",)  # trunks that need no weights


def add_parser(subparsers: "argparse._SubParsersAction[argparse.ArgumentParser]") -> None:
    what = "Adapts the vocabulary and projections of a model to your own images, without training."
    parser = subparsers.add_parser("fit", help=what, description=what)
    parser.add_argument(
        "--images", nargs="+", required=True, metavar="DIR", help="folders of images of your environment"
    )
    parser.add_argument("-o", "--output", required=True, metavar="FILE", help="model file to write (.safetensors)")
    parser.add_argument("--weights", default="default", help="model whose trunk is kept: 'default' or a model file")
    parser.add_argument(
        "--trunk", choices=_UNTRAINED, help="a trunk without trained weights instead of that of --weights"
    )
    parser.add_argument(
        "--anew",
        action="store_true",
        help="a new vocabulary and PCA instead of adapting the model's; what its training learned there is lost",
    )
    parser.add_argument(
        "--poses", metavar="FILE", help="where the images were taken (column frame): those near one another show one "
        "place; without it, those that follow one another by name in a folder"
    )  # fmt: skip
    parser.add_argument("--clusters", type=int, help="K; default: the model's, or 16")
    parser.add_argument("--global-dim", type=int, help="D of the global vector; default: the model's, or 512")
    parser.add_argument("--patch-dim", type=int, help="D of patches; default: the model's, or 64")
    parser.add_argument("--no-whiten", action="store_true", help="PCA without whitening")
    parser.add_argument(
        "--most", type=int, default=1500, help="images used at most, drawn evenly by --seed (default 1500)"
    )
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--device", default="cpu", choices=("cpu", "cuda"))
    parser.add_argument(
        "--queries", metavar="DIR", help="with --references and --matches: report recall before and after"
    )
    parser.add_argument("--references", metavar="DIR")
    parser.add_argument("--matches", metavar="CSV")
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    import torch

    from pnv_core.describe.download import resolve_weights
    from pnv_core.describe.model_files import ModelInfo, load_model, save_model
    from pnv_core.describe.torch_model import TorchModel, TorchTrunk
    from pnv_core.describe.trunks import TRUNKS
    from pnv_lab.fit import adapt_model, fit_model, image_files
    from pnv_lab.poses import read_poses

    output = writable(args.output)
    torch.set_num_threads(max(args.threads, 1))
    if args.device == "cuda" and not torch.cuda.is_available():
        raise ConfigError("device = 'cuda' but torch sees no CUDA device; allowed here: cpu")
    measured = [args.queries, args.references, args.matches]
    if any(measured) and not all(measured):
        raise ConfigError("recall needs all of --queries, --references and --matches; allowed: all three or none")
    files = image_files(args.images)
    if len(files) > args.most:
        files = sorted(random.Random(args.seed).sample(files, args.most))
    base = None if args.trunk else load_model(resolve_weights(args.weights))
    anew = bool(base is None or args.anew or args.clusters or args.global_dim or args.patch_dim or args.no_whiten)
    if anew:
        trunk = TorchTrunk(TRUNKS.make(args.trunk)) if base is None else TorchModel.of(base).trunk
        info = ModelInfo(args.trunk) if base is None else base.info
        model = fit_model(trunk.to(args.device), info, files, _options(args, base), _bar)
    else:
        assert base is not None
        adapted = TorchModel.of(base)
        adapted.trunk.to(args.device)
        model = adapt_model(adapted, files, read_poses(args.poses) if args.poses else None, _bar)
    what = "vocabulary and projections fitted" if anew else "global projection adapted"
    source = (args.trunk if base is None else base.info.provenance or base.info.trunk).strip()
    provenance = f"{what} to {len(files)} images by pnv fit; before: {source}"
    fitted = model.model().with_info(provenance=provenance, calibration=None)
    save_model(fitted, output)
    print(
        f"{output}: {what}; K = {fitted.clusters}, D = {fitted.global_dim}, patches D = {fitted.patch_dim}, "
        f"{output.stat().st_size / 1e6:.1f} MB"
    )
    if all(measured):
        _report(args, base, output)
    return 0


def _options(args: argparse.Namespace, base: "Model | None") -> "FitOptions":
    """The base model's sizes unless given."""
    from pnv_lab.fit import FitOptions

    plain = FitOptions(patch_dim=64)
    given: dict[str, Any] = {
        "clusters": args.clusters or (base.clusters if base else plain.clusters),
        "global_dim": args.global_dim or (base.global_dim if base else plain.global_dim),
        "patch_dim": args.patch_dim or (base.patch_dim if base else plain.patch_dim),
    }
    if bad := [f"{name} = {value}" for name, value in given.items() if value < 1]:
        raise ConfigError(f"{', '.join(bad)} is out of range; allowed: whole number of at least 1")
    if base:
        given |= {
            "image_width": base.info.image_width,
            "image_height": base.info.image_height,
            "patch_sizes": base.info.patch_sizes,
            "patch_weights": base.info.patch_weights,
        }
    return FitOptions(**given, whiten=not args.no_whiten, seed=args.seed)


def _report(args: argparse.Namespace, base: "Model | None", output: Path) -> None:
    """Recall with the model the fit began from and with the fitted one."""
    from pnv_cli.recall import progress
    from pnv_core.config import Config
    from pnv_lab.evaluation.datasets.pairs import pairs_dataset
    from pnv_lab.evaluation.evaluate import Evaluation
    from pnv_lab.evaluation.methods import configured_method, global_method
    from pnv_lab.evaluation.metrics import recall_at
    from pnv_lab.evaluation.store import default_cache

    dataset = pairs_dataset(args.queries, args.references, args.matches)
    print(f"{'':8}{'global R@1':>12}{'R@5':>7}{'re-ranked R@1':>16}{'R@5':>7}")
    models = [("after", str(output))] if base is None else [("before", args.weights), ("after", str(output))]
    for name, weights in models:
        config = Config.make(weights=weights, device=args.device, threads=args.threads)
        results = Evaluation(config, default_cache(), progress).run(dataset, [global_method(), configured_method()])
        found = [100 * recall_at(result.hits, n) for result in results for n in (1, 5)]
        print(f"{name:8}{found[0]:12.1f}{found[1]:7.1f}{found[2]:16.1f}{found[3]:7.1f}")


def _bar(items: Iterable[Path], what: str) -> Iterable[Path]:
    return bar(items, desc=what, unit="image")
