"""What the recogniser says when it is given something it cannot use."""


class PnvError(ValueError):
    """Unusable input. The message is one line: what was given, and what is allowed."""


class ImageError(PnvError):
    """An image that cannot be decoded or described."""


class ModelError(PnvError):
    """A model or checkpoint file that is not one."""


class ConfigError(PnvError):
    """A setting outside its declared limits."""


class MapError(PnvError):
    """A saved map that is damaged, of another model, or not a map."""
