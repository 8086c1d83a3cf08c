"""Pictures of profiles, fits and errors."""

from ._counts import plot_error_by_count as plot_error_by_count
from ._fit import plot_fit as plot_fit
from ._recovery import plot_recovery as plot_recovery
from ._figure_1 import figure_1 as figure_1
from ._figure_3 import figure_3 as figure_3
from ._figure_4 import figure_4 as figure_4
from ._figure_5 import figure_5 as figure_5
from ._figure_6 import figure_6 as figure_6
from ._figure_7 import figure_7 as figure_7
from ._figure_8 import figure_8 as figure_8
from ._subject import bright as bright, picture_grid as picture_grid, Subject as Subject
