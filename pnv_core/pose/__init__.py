"""Where two views of one place lie relative to each other, and how closures are written down."""
