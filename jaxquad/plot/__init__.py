"""Figures with matplotlib."""

from ._bode import bode as bode, COHERENT as COHERENT, Model as Model
from ._certificate import certificate_figure as certificate_figure
from ._convergence import convergence_figure as convergence_figure
from ._front import front_figure as front_figure
from ._histories import histories as histories
from ._labels import short_names as short_names, unit_label as unit_label, visible as visible
from ._overlay import overlay as overlay
from ._record import (
    channels_of as channels_of,
    extremes as extremes,
    record_figure as record_figure,
    ROWS as ROWS,
)
from ._residuals import (
    residual_figure as residual_figure,
    Residuals as Residuals,
    residuals_of as residuals_of,
)
