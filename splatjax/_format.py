"""Formatting of counts, numbers, errors and channel names as text."""

import math
from collections.abc import Iterable
from typing import Any

CHANNEL_COLORS = ("#c0392b", "#27853f", "#2c5aa0")  # for three channels, on white


def channel_names(count: int) -> tuple[str, ...]:
    """Return default names of channels; three are red, green and blue."""
    if count == 3:
        return ("red", "green", "blue")
    return tuple(f"channel {channel + 1}" for channel in range(count))


def counted(count: int, noun: str) -> str:
    """Format a count with a noun whose plural ends in s."""
    return f"{count} {noun}{'' if count == 1 else 's'}"


def format_numbers(values: Iterable[Any], form: str) -> str:
    """Format numbers in one line."""
    return "  ".join(f"{float(value):{form}}" for value in values)


def percent(fraction: float) -> str:
    """Format a relative error as a percentage with two significant digits."""
    if not math.isfinite(fraction) or fraction > 10:
        return "anything"
    return f"{float(f'{100 * fraction:.2g}'):g}%"
