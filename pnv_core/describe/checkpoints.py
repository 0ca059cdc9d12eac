"""Official Patch-NetVLAD checkpoints: a torch file of {num_pcs, state_dict} holding VGG16, NetVLAD and WPCA.

K clusters, P output dimensions. Both are read from the shapes.
"""

import os
import pickle
import zipfile
from pathlib import Path
from typing import Any

from pnv_core.describe.model_files import Model, ModelInfo, Tensors, build_model
from pnv_core.describe.trunks.vgg16 import vgg16_trunk
from pnv_core.errors import ModelError

_CONVOLUTIONS = ("pool.conv.weight", "WPCA.0.weight")  # 1x1, taken as matrices


def load_checkpoint(path: Path | str) -> Model:
    """Read an official checkpoint (float32 or float64 WPCA, `module.` prefixes allowed).

    Only plain tensors are unpickled (weights_only). Raises ModelError for anything else, naming file and fault.
    """
    import torch  # slow to import; what was read is kept converted (describer.read_model)

    source = str(path)
    _require_plain_archive(source)
    try:
        content = torch.load(source, map_location="cpu", weights_only=True)
    except FileNotFoundError:
        raise ModelError(f"{source}: no such checkpoint file") from None
    except pickle.UnpicklingError:
        raise ModelError(
            f"{source}: is no plain tensor file (its pickle is damaged or holds other objects); refused"
        ) from None
    except Exception as error:  # torch raises whatever its readers meet in a damaged file
        reason = str(error).strip().splitlines()[0] if str(error).strip() else type(error).__name__
        raise ModelError(f"{source}: not a readable torch checkpoint, or truncated ({reason[:160]})") from None
    return build_model(
        ModelInfo(trunk="vgg16", provenance=f"checkpoint {Path(source).name}"), _renamed(content, source), source
    )


def _require_plain_archive(source: str) -> None:
    """Refuse an archive that unpacks to more than it is, before anything is unpacked: torch compresses nothing."""
    try:
        if not zipfile.is_zipfile(source):
            return
        with zipfile.ZipFile(source) as archive:
            unpacked = sum(item.file_size for item in archive.infolist())
            packed = any(item.compress_type != zipfile.ZIP_STORED for item in archive.infolist())
    except FileNotFoundError:
        return  # said by who opens it
    except Exception as error:
        raise ModelError(f"{source}: not a readable torch checkpoint ({error})") from None
    size = os.path.getsize(source)
    if packed or unpacked > size:
        raise ModelError(f"{source}: {size} bytes that unpack to {unpacked}; allowed: a checkpoint as torch writes it")


def _renamed(content: Any, source: str) -> Tensors:
    """The checkpoint's tensors under the names of a model file."""
    state = content.get("state_dict") if isinstance(content, dict) else None
    if not isinstance(state, dict):
        held = sorted(map(str, content)) if isinstance(content, dict) else type(content).__name__
        raise ModelError(f"{source}: holds {held}; allowed: a dict of num_pcs and state_dict")
    expected = {f"encoder.{name.removeprefix('features.')}": f"trunk.{name}" for name in vgg16_trunk().tensor_shapes()}
    expected |= {
        "pool.centroids": "netvlad.centroids",
        "pool.conv.weight": "netvlad.assignment",
        "WPCA.0.weight": "global_projection.weight",
        "WPCA.0.bias": "global_projection.bias",
    }
    tensors: dict[str, Any] = {}
    shapes = {}
    unexpected = []
    for given, tensor in state.items():
        key = str(given).replace("module.", "")
        array = tensor.numpy() if hasattr(tensor, "is_floating_point") and tensor.is_floating_point() else None
        if key not in expected or array is None:
            unexpected.append(str(given))
            continue
        name = expected[key]
        if name in tensors:
            raise ModelError(f"{source}: {key} occurs twice, with and without 'module.'")
        shapes[key] = array.shape
        tensors[name] = array.reshape(len(array), -1) if key in _CONVOLUTIONS else array
    if unexpected:
        raise ModelError(
            f"{source}: unexpected keys {', '.join(sorted(unexpected)[:4])}; "
            f"allowed: {', '.join(list(expected)[:2])}, ... WPCA.0.bias"
        )
    if missing := [key for key, name in expected.items() if name not in tensors]:
        raise ModelError(f"{source}: lacks {', '.join(missing[:4])}{' ...' if len(missing) > 4 else ''}")
    for key in _CONVOLUTIONS:
        if len(shapes[key]) != 4 or shapes[key][2:] != (1, 1):
            raise ModelError(
                f"{source}: {key} has shape {tuple(shapes[key])}; allowed: a 1x1 convolution (outputs, inputs, 1, 1)"
            )
    pcs = content.get("num_pcs")
    outputs = tensors["global_projection.bias"].size
    if pcs is not None and (not isinstance(pcs, int) or pcs != outputs):
        raise ModelError(f"{source}: num_pcs says {pcs!r} but WPCA.0.bias has {outputs} entries")
    return tensors
