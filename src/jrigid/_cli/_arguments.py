"""Texts of the command line as values; argparse reports what cannot be read."""

import argparse
from pathlib import Path

_PICTURES = (".png", ".pdf", ".svg", ".jpg", ".jpeg", ".tif", ".tiff", ".webp", ".eps")


def numbers(text: str) -> list[float]:
    """Numbers between commas; an empty list if one of them is none."""
    try:
        return [float(x) for x in text.split(",")]
    except ValueError:
        return []


def output(text: str) -> str:
    """A file that can be written: its folder must exist.

    This is checked before a search, which may take minutes.
    """
    folder = Path(text).parent
    if not folder.is_dir():
        message = f"its folder must exist, but {str(folder)!r} does not"
        raise argparse.ArgumentTypeError(message)
    return text


def picture(text: str) -> str:
    """A file of a picture that can be written, in a format that matplotlib has."""
    suffix = Path(text).suffix.lower()
    # A file without a suffix becomes a PNG.
    if suffix and suffix not in _PICTURES:
        message = (
            f"its suffix must be one of {', '.join(_PICTURES)}, but it is {suffix}"
        )
        raise argparse.ArgumentTypeError(message)
    return output(text)


def count(text: str) -> int:
    """A whole number of at least 1."""
    if not text.isdecimal() or int(text) < 1:
        message = f"it must be a whole number from 1, but it is {text!r}"
        raise argparse.ArgumentTypeError(message)
    return int(text)
