"""Texts of the command line as values; argparse reports what cannot be read."""

import argparse
from pathlib import Path


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


def count(text: str) -> int:
    """A whole number of at least 1."""
    if not text.isdecimal() or int(text) < 1:
        message = f"it must be a whole number from 1, but it is {text!r}"
        raise argparse.ArgumentTypeError(message)
    return int(text)
