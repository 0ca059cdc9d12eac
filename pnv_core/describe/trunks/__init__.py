"""Feature trunks: an image to a dense feature map. A new one is a file here and a line below, or `TRUNKS.register`."""

from typing import TYPE_CHECKING

from pnv_core.errors import ModelError
from pnv_core.registry import Registry

if TYPE_CHECKING:
    from pnv_core.describe.trunks.trunk import Trunk

TRUNKS: "Registry[Trunk]" = Registry(
    "trunk",
    {
        "vgg16": "pnv_core.describe.trunks.vgg16:vgg16_trunk",
        "lite": "pnv_core.describe.trunks.lite:lite_trunk",
        "rootsift": "pnv_core.describe.trunks.rootsift:rootsift_trunk",
    },
    ModelError,
)
