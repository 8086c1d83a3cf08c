"""Media, interfaces and reference profiles."""

from ._medium import Medium as Medium
