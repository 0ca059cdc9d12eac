"""What the fleet says when it cannot go on."""

from pnv_core.errors import PnvError


class FleetError(PnvError):
    """A store that cannot be used, a row that is not believed, an outbox that is damaged. One line."""
