"""Pictures of profiles, fits and errors."""

from ._fit import plot_error_by_count as plot_error_by_count, plot_fit as plot_fit
from ._pictures import plot_pictures as plot_pictures, plot_recovery as plot_recovery
