"""`pnv train`: train a model for places on folders of images."""

import argparse
import json
from collections.abc import Iterable, Iterator
from dataclasses import asdict, fields
from pathlib import Path
from typing import Any

from pnv_cli.common import writable
from pnv_cli.progress import bar
from pnv_core.errors import ConfigError

_VARIANT = 0  # of EfficientNet-Lite
_POOLED_SHARE, _MIDDLE_SHARE = 0.45, 0.275  # of the cosine; chosen on the development sets, see MODEL_CARD.md


def add_parser(subparsers: "argparse._SubParsersAction[argparse.ArgumentParser]") -> None:
    what = "Trains a model for places: hours on a CPU, minutes with --pool."
    parser = subparsers.add_parser("train", help=what, description=what)
    parser.add_argument("--data", nargs="+", required=True, metavar="DIR", help="training folders, or folders of them")
    parser.add_argument("-o", "--output", required=True, metavar="FILE", help="model file to write (.safetensors)")
    parser.add_argument(
        "--folder", metavar="DIR", help="checkpoint, metrics and plot; default: the output's name + .train"
    )
    parser.add_argument(
        "--trunk", choices=("lite", "vgg16"), default="lite", help="vgg16: the paper's training, its settings"
    )
    parser.add_argument(
        "--imagenet", required=True, metavar="FILE", help="ImageNet weights of the trunk (.pth; the published names)"
    )
    parser.add_argument("--device", choices=("cpu", "cuda"), default="cpu")
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--seed", type=int, help="default: the settings' own")
    parser.add_argument(
        "--pool",
        type=int,
        default=0,
        metavar="N",
        help="groups of 80 views rendered once and kept as maps of the frozen layers (for a CPU); 0 = none",
    )
    parser.add_argument("--clusters", type=int, default=16, help="K (default 16)")
    parser.add_argument("--neck", type=int, default=128, help="channels after the lite trunk (default 128)")
    parser.add_argument("--global-dim", type=int, default=512)
    parser.add_argument("--pooled-dim", type=int, default=160, help="of --global-dim, for the pooled last maps")
    parser.add_argument(
        "--middle-dim", type=int, default=160, help="of --global-dim, for the pooled maps before the neck; 0 = none"
    )
    parser.add_argument("--patch-dim", type=int, default=128)
    parser.add_argument(
        "--pooled-share", type=float, default=_POOLED_SHARE,
        help=f"of the cosine, for the pooled last maps (default {_POOLED_SHARE:g}); 1: GeM alone",
    )  # fmt: skip
    parser.add_argument(
        "--middle-share", type=float, default=_MIDDLE_SHARE,
        help=f"of the cosine, for the pooled maps before the neck (default {_MIDDLE_SHARE:g})",
    )  # fmt: skip
    parser.add_argument(
        "--loss", choices=("ms", "ap"), default="ms",
        help="of a training with steps: multi-similarity, or listwise average precision "
        "(--pooled-share 1 --middle-dim 0: AP-GeM)",
    )  # fmt: skip
    parser.add_argument("--size", default="384x288", help="input size of the lite model (default 384x288)")
    parser.add_argument("--view", default="384x288", help="size of the views it is trained on (default 384x288)")
    parser.add_argument("--places", type=int, default=40, help="places a batch (default 40)")
    parser.add_argument("--views", type=int, default=3, help="views a place (default 3)")
    parser.add_argument(
        "--set",
        nargs="*",
        default=[],
        metavar="NAME=VALUE",
        help="any other setting of the training, e.g. steps=1500 trunk_lr=0.0001",
    )
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    import cv2
    import torch

    output = writable(args.output)
    torch.set_num_threads(max(args.threads, 1))
    cv2.setNumThreads(0)
    if args.device == "cuda" and not torch.cuda.is_available():
        raise ConfigError("device = 'cuda' but torch sees no CUDA device; allowed here: cpu")
    folder = Path(args.folder) if args.folder else output.with_name(output.name + ".train")
    if args.trunk == "vgg16":
        _train_vgg16(args, folder, output)
    else:
        _train_lite(args, folder, output)
    return 0


def _train_lite(args: argparse.Namespace, folder: Path, output: Path) -> None:
    import numpy as np

    from pnv_core.describe.model_files import ModelInfo, save_model
    from pnv_lab.fit import FitOptions
    from pnv_lab.training.batches import BatchOptions, PlaceBatches
    from pnv_lab.training.initial import imagenet_trunk, initial_model, whitened
    from pnv_lab.training.pool import FeaturePool
    from pnv_lab.training.trainer import Trainer, TrainOptions

    if args.middle_dim < 0 or not 1 <= args.pooled_dim < args.global_dim - args.middle_dim:
        raise ConfigError(
            f"--pooled-dim {args.pooled_dim}, --middle-dim {args.middle_dim}; allowed: together below --global-dim"
        )
    middle = args.middle_share if args.middle_dim else 0.0
    if not 0 <= middle <= 1 - args.pooled_share <= 1:
        raise ConfigError(f"--pooled-share {args.pooled_share:g}, --middle-share {middle:g}; allowed: 0 to 1 together")
    given = {"seed": args.seed} if args.seed is not None else {}
    options = _options(TrainOptions, args.set, **({"steps": 0, "loss": args.loss} | given))
    size, view = _size(args.size), _size(args.view)
    trained, held = _split(args.data)
    trunk = imagenet_trunk(args.imagenet, _VARIANT, deep=True)
    layers = min(options.frozen_layers, trunk.depth - 1)
    # the pool draws four views a place; a training batch takes some of them
    drawn = BatchOptions(
        places=20, views=4, neighbours=4, sizes=(view,), forward=0.0, thumbnails=0.1, zoom=0.3, squeezed=0.4,
        seed=options.seed + 7,
    )  # fmt: skip
    rendered = PlaceBatches(trained, drawn)
    pool = FeaturePool(folder / "pool", rendered, args.pool or 20, args.places, args.views)
    pool.build(trunk, layers, bar(range(pool.groups), desc="views", unit="group"))
    info = ModelInfo(
        "lite",
        {"variant": _VARIANT, "neck": args.neck, "deep": True},
        *size,
        patch_sizes=(2,),  # as good as any set of sizes 1 to 3 on the development sets, for the least memory
        patch_weights=(1.0,),
        pooled_share=args.pooled_share,
        middle_share=middle,
        provenance=f"pnv train, seed {options.seed}, {options.steps} steps on {len(trained)} images; see MODEL_CARD.md",
    )
    fit = FitOptions(
        clusters=args.clusters,
        global_dim=args.global_dim,
        pooled_dim=args.pooled_dim,
        middle_dim=args.middle_dim,
        patch_dim=args.patch_dim,
        patch_sizes=(2,),
        seed=options.seed,
    )
    model = initial_model(trunk, args.neck, pool, layers, info, fit)
    if not options.steps:
        save_model(model.model(), output, np.float16)
        print(f"{output}: {output.stat().st_size / 1e6:.1f} MB")
        return
    fresh = BatchOptions(places=args.places, views=args.views, sizes=(view,), seed=options.seed)
    batches = pool if args.pool else PlaceBatches(trained, fresh)
    settings = {"places": args.places, "views": args.views, "pool": args.pool, "fit": asdict(fit)}
    trainer = Trainer(model, batches, _validation(held), options, folder, args.device, settings)
    model = trainer.run(lambda items, done, total: bar(items, desc="training", initial=done, total=total, unit="step"))
    save_model(whitened(model, pool, layers, fit).model(), output, np.float16)
    _report(trainer.journal, folder, output)


def _train_vgg16(args: argparse.Namespace, folder: Path, output: Path) -> None:
    """Patch-NetVLAD's own training; the projection is fitted afterwards, as the authors do."""
    import numpy as np
    import torch

    from pnv_core.describe.model_files import ModelInfo, save_model
    from pnv_core.describe.torch_model import TorchModel
    from pnv_lab.fit import FitOptions, as_batch, projections_of, vocabulary_of
    from pnv_lab.training.augment import flat_view
    from pnv_lab.training.triplets import TripletOptions, TripletTrainer
    from pnv_lab.training.vgg import imagenet_vgg16

    given = {"seed": args.seed} if args.seed is not None else {}
    options = _options(TripletOptions, args.set, **given)
    trained, held = _split(args.data)
    trunk = imagenet_vgg16(args.imagenet)
    flat = [i for i in trained if not i.panorama]
    size = (options.width, options.height)
    fit = FitOptions(
        clusters=args.clusters,
        global_dim=min(args.global_dim, len(flat) - 1),
        patch_dim=args.patch_dim,
        image_width=size[0],
        image_height=size[1],
        patch_sizes=(2, 5, 8),
        seed=options.seed,
    )

    def maps(what: str) -> Iterator[torch.Tensor]:
        chosen = np.random.default_rng(options.seed).permutation(len(flat))[:1000]
        for i in bar(chosen, desc=what, unit="image"):
            pixels = flat_view(flat[i].rgb, size, 0.0, False, np.random.default_rng(0)).pixels
            with torch.no_grad():
                yield trunk(as_batch([pixels], args.device)).float()

    trunk.to(args.device)
    netvlad = vocabulary_of(maps("vocabulary"), fit)
    trainer = TripletTrainer(trunk, netvlad, trained, _validation(held), options, folder, args.device)
    trainer.run(lambda items, done, total: bar(items, desc="training", initial=done, total=total, unit="cache"))
    whole, _ = projections_of(netvlad.cpu(), maps("projection"), fit)
    info = ModelInfo(
        "vgg16", {}, *size, provenance=f"pnv train --trunk vgg16, {options.epochs} epochs on {len(flat)} images"
    )
    save_model(TorchModel(info, trunk.cpu(), netvlad, whole).model(), output)
    _report(trainer.journal, folder, output)


def _split(folders: Iterable[str]) -> tuple[list[Any], list[Any]]:
    """The images of every set under the folders: those to train on, and those kept out to validate on."""
    from pnv_lab.training.sources import is_held, load_set

    sets: list[Path] = []
    for folder in map(Path, folders):
        if _is_set(folder):
            sets.append(folder)
        elif folder.is_dir() and (found := sorted(f for f in folder.iterdir() if _is_set(f))):
            sets += found
        else:
            raise ConfigError(f"{folder}: no training folder; allowed: one with images/ or panos/, or a folder of such")
    images = [image for folder in bar(sets, desc="sets", unit="set") for image in load_set(folder)]
    held = [image for image in images if is_held(image)]
    chosen = set(map(id, held))
    return [image for image in images if id(image) not in chosen], held


def _is_set(folder: Path) -> bool:
    return (folder / "images").is_dir() or (folder / "panos").is_dir()


def _validation(held: list[Any]) -> list[Any]:
    from pnv_lab.training.sources import HELD_SETS
    from pnv_lab.training.validation import synthetic_queries

    size = (320, 240)
    tower = [i for i in held if i.set_name == "ie_tower"]
    panoramas = [i for i in held if i.panorama]
    others = [i for i in held if i.set_name in HELD_SETS]
    parts = (("tower", tower, 100), ("panoramas", panoramas, 0), ("others", others, 60))
    return [
        synthetic_queries(name, images, size, most, seed)
        for seed, (name, images, most) in enumerate(parts, 1)
        if images
    ]


def _options(kind: Any, given: list[str], **defaults: Any) -> Any:
    """A dataclass of settings from NAME=VALUE. Raises ConfigError for a name or value that is none."""
    types: dict[str, Any] = {f.name: type(f.default) for f in fields(kind)}
    values = dict(defaults)
    for text in given:
        name, equals, value = text.partition("=")
        if name not in types or not equals:
            raise ConfigError(f"--set {text!r} is no setting; allowed: {', '.join(types)}, as NAME=VALUE")
        try:
            read = json.loads(value.lower()) if types[name] in (bool, tuple) else types[name](value)
        except ValueError:
            raise ConfigError(f"--set {text!r}: allowed: a {types[name].__name__}") from None
        values[name] = tuple(read) if types[name] is tuple else read
    return kind(**values)


def _size(text: str) -> tuple[int, int]:
    width, _, height = text.partition("x")
    if not (width.isdigit() and height.isdigit() and int(width) >= 80 and int(height) >= 80):
        raise ConfigError(f"size {text!r} is out of range; allowed: WIDTHxHEIGHT of at least 80 px each")
    return int(width), int(height)


def _report(journal: Any, folder: Path, output: Path) -> None:
    from pnv_lab.training.journal import plot

    try:
        plot(journal, folder / "training.png")
    except ImportError:
        print(f"no plot: matplotlib is not installed; the figures are in {journal.metrics}")
    last: dict[str, Any] = next((row for row in reversed(journal.rows()) if any("recall" in name for name in row)), {})
    print(f"{output}: {output.stat().st_size / 1e6:.1f} MB; metrics and plot in {folder}")
    for name, value in last.items():
        if "recall" in name:
            print(f"  {name}: {value:.3f}")
