"""The executable `place_recognizer`."""


def main() -> int:
    return 0
