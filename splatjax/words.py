"""Numbers as they are said to a person."""

import math


def channel_names(count: int) -> tuple[str, ...]:
    """Give what channels are called where nobody has named them: red, green and blue if they are
    three.
    """
    return (
        ("red", "green", "blue")
        if count == 3
        else tuple(f"channel {channel + 1}" for channel in range(count))
    )


def counted(count: int, what: str) -> str:
    """Write how many there are of something, whose plural ends in s."""
    return f"{count} {what}{'' if count == 1 else 's'}"


def percent(share: float) -> str:
    """Write a relative error."""
    return (
        "anything"
        if not math.isfinite(share) or share > 10
        else f"{float(f'{100 * share:.2g}'):g}%"
    )
