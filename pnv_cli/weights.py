"""pnv weights list | fetch NAME | verify NAME or FILE"""

import argparse

from pnv_cli.progress import bar
from pnv_core.describe.download import DEFAULT_MODEL, PUBLISHED, fetch, file_sha256, recorded_sha256, resolve_weights
from pnv_core.errors import ModelError


def add_parser(subparsers: argparse._SubParsersAction) -> None:
    parser = subparsers.add_parser("weights", help="published models: list, fetch, verify", allow_abbrev=False)
    actions = parser.add_subparsers(required=True, metavar="ACTION")
    listing = actions.add_parser("list", help="the models there are, and which are on this machine")
    listing.set_defaults(run=_list)
    fetching = actions.add_parser("fetch", help="download a published model, resuming where it stopped")
    fetching.add_argument("name", metavar="NAME", help=", ".join(PUBLISHED))
    fetching.set_defaults(run=_fetch)
    verifying = actions.add_parser("verify", help="load a model file and check it against its recorded hash")
    verifying.add_argument("file", metavar="FILE", help="a model file, or a name that `pnv weights list` prints")
    verifying.set_defaults(run=_verify)


def _list(args: argparse.Namespace) -> int:
    print(f"{'default':<20} shipped  {DEFAULT_MODEL}")
    for item in PUBLISHED.values():
        state = "here   " if item.path.exists() else "absent "
        print(
            f"{item.name:<20} {state}  K={item.clusters} D={item.dim}  {item.path if item.path.exists() else item.url}"
        )
    return 0


def _fetch(args: argparse.Namespace) -> int:
    with bar(unit="B", unit_scale=True, desc=args.name) as shown:

        def progress(done: int, total: int) -> None:
            shown.total = total or None
            shown.update(done - shown.n)

        path = fetch(args.name, progress)
    print(f"{path}: sha256 {file_sha256(path)}")
    return 0


def _verify(args: argparse.Namespace) -> int:
    from pnv_core.describe.describer import read_model

    path = resolve_weights(args.file)
    model = read_model(path)
    digest = file_sha256(path)
    for item in PUBLISHED.values():
        recorded = recorded_sha256(item) if item.path.resolve() == path.resolve() else None
        if recorded and recorded != digest:
            raise ModelError(f"{path}: sha256 {digest} differs from the recorded {recorded}; fetch it again")
    print(
        f"{path}: {model.info.trunk}, K={model.clusters}, D={model.global_dim}, patch D={model.patch_dim}, "
        f"fingerprint {model.fingerprint()[:16]}, sha256 {digest}"
    )
    return 0
