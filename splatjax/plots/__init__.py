"""Pictures of profiles, fits and errors."""

from ._fit import plot_fit as plot_fit
