from ._bode import bode as bode, coherence as coherence
from ._certificate import certificate_figure as certificate_figure
from ._curves import (
    FlownAgain as FlownAgain,
    Spectrum as Spectrum,
    StepBand as StepBand,
    ThrottleCurve as ThrottleCurve,
)
from ._flight import flight as flight
from ._histories import (
    channels_of as channels_of,
    extremes as extremes,
    histories as histories,
    record_figure as record_figure,
    ROWS as ROWS,
)
from ._labels import plain_ticks as plain_ticks
from ._names import (
    COHERENT as COHERENT,
    short_names as short_names,
    unit_label as unit_label,
    visible as visible,
)
from ._panels import headless as headless, Panels as Panels
from ._pilot import (
    again_figure as again_figure,
    b0_figure as b0_figure,
    balance_figure as balance_figure,
    filters_figure as filters_figure,
    spectra_figure as spectra_figure,
    steps_figure as steps_figure,
)
from ._plane import nyquist as nyquist, pzmap as pzmap
from ._predictions import compare as compare, step as step
from ._residuals import resid as resid, Residuals as Residuals, residuals_of as residuals_of
from ._spectrogram import spectrogram as spectrogram
from ._tuning import convergence_figure as convergence_figure, front_figure as front_figure
