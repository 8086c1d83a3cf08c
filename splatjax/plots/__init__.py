"""Pictures of profiles, fits and errors."""

from ._counts import plot_error_by_count as plot_error_by_count
from ._fit import plot_fit as plot_fit
from ._pictures import plot_pictures as plot_pictures
from ._recovery import plot_recovery as plot_recovery
