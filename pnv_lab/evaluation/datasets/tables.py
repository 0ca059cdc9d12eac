"""Reading the small text tables that data sets come with; every complaint names file and line."""

import csv
from pathlib import Path

from pnv_core.errors import PnvError


def words(path: Path) -> list[tuple[int, list[str]]]:
    """(line number, words) of every line that is neither empty nor a # comment. Raises PnvError without the file."""
    try:
        text = path.read_text(encoding="utf-8-sig")
    except FileNotFoundError:
        raise PnvError(f"{path}: no such file") from None
    except (OSError, UnicodeDecodeError) as error:
        raise PnvError(f"{path}: cannot be read ({error})") from None
    lines = enumerate(text.splitlines(), 1)
    return [(n, line.split()) for n, line in lines if line.strip() and not line.lstrip().startswith("#")]


def numbers(path: Path, line: int, texts: list[str], count: int) -> list[float]:
    """Exactly `count` numbers of a line. Raises PnvError."""
    try:
        values = [float(t) for t in texts]
    except ValueError:
        raise PnvError(f"{path} line {line}: {' '.join(texts)[:60]!r} are no numbers") from None
    if len(values) != count:
        raise PnvError(f"{path} line {line}: {len(values)} numbers; allowed: {count}")
    return values


def rows(path: Path, columns: tuple[str, ...]) -> list[dict[str, str]]:
    """Rows of a csv that has the columns. Raises PnvError."""
    try:
        with open(path, newline="", encoding="utf-8-sig") as file:
            reader = csv.DictReader(file)
            reader.fieldnames = [name.strip().lstrip("#").strip() for name in reader.fieldnames or ()]
            if missing := set(columns) - set(reader.fieldnames):
                raise PnvError(
                    f"{path}: lacks the column {', '.join(sorted(missing))}; it has {', '.join(reader.fieldnames)}"
                )
            return list(reader)
    except FileNotFoundError:
        raise PnvError(f"{path}: no such file") from None
    except (UnicodeDecodeError, csv.Error) as error:
        raise PnvError(f"{path}: is no csv text ({error})") from None


def number(path: Path, row: dict[str, str], column: str) -> float:
    """A number of a csv row. Raises PnvError."""
    try:
        return float(row[column])
    except (TypeError, ValueError):
        raise PnvError(f"{path}: {column} {row[column]!r} is no number") from None


def existing(root: Path, names: list[str]) -> tuple[Path, ...]:
    """The files, .jpg for .png and the reverse where only that exists. Raises PnvError naming the first absent one."""
    found = []
    for name in names:
        options = [root / name] + [(root / name).with_suffix(s) for s in (".jpg", ".png")]
        path = next((p for p in options if p.is_file()), None)
        if path is None:
            raise PnvError(f"{root / name}: no such image, though the data set's list names it")
        found.append(path)
    return tuple(found)
