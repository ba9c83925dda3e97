from ._bode import (
    bode as bode,
    COHERENT as COHERENT,
    Model as Model,
    model_response as model_response,
    residual_figure as residual_figure,
    Residuals as Residuals,
    residuals_of as residuals_of,
)
from ._certificate import certificate_figure as certificate_figure
from ._histories import (
    channels_of as channels_of,
    extremes as extremes,
    histories as histories,
    overlay as overlay,
    record_figure as record_figure,
    ROWS as ROWS,
)
from ._labels import (
    plain_ticks as plain_ticks,
    short_names as short_names,
    unit_label as unit_label,
    visible as visible,
)
from ._tuning import convergence_figure as convergence_figure, front_figure as front_figure
