"""pnv describe IMAGE -o OUT.npz"""

import argparse
from typing import Any

from pnv_cli.common import add_config_flags, config_from, writable


def add_parser(subparsers: argparse._SubParsersAction) -> None:
    parser = subparsers.add_parser("describe", description="Writes the descriptors of an image as arrays.")
    parser.add_argument("image")
    parser.add_argument(
        "-o", "--output", required=True, metavar="OUT.npz", help="global (D,), patches_P (n, D), grid_P (rows, cols)"
    )
    add_config_flags(parser, sections=("Describing",))
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    import numpy as np

    from pnv_core.describe.describer import describer_from
    from pnv_core.files import atomic_write
    from pnv_core.images import read_image

    output = writable(args.output)
    config = config_from(args)
    image = read_image(args.image)
    descriptor = describer_from(config).describe(image)
    arrays: dict[str, Any] = {"global": descriptor.global_vector}
    for grid in descriptor.patches:
        arrays[f"patches_{grid.size}"] = np.asarray(grid.descriptors, np.float32)
        arrays[f"grid_{grid.size}"] = np.array([grid.rows, grid.cols])
    with atomic_write(output) as file:
        np.savez(file, **arrays)
    shapes = ", ".join(f"{name} {array.shape}" for name, array in arrays.items() if not name.startswith("grid"))
    print(f"{output}: {shapes}")
    return 0
