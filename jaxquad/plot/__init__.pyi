from ._bode import bode as bode, coherence as coherence
from ._histories import (
    channels_of as channels_of,
    extremes as extremes,
    histories as histories,
    record_figure as record_figure,
    ROWS as ROWS,
    spectrogram as spectrogram,
)
from ._panels import (
    COHERENT as COHERENT,
    headless as headless,
    Panels as Panels,
    plain_ticks as plain_ticks,
    short_names as short_names,
    unit_label as unit_label,
    visible as visible,
)
from ._pilot import (
    again_figure as again_figure,
    b0_figure as b0_figure,
    balance_figure as balance_figure,
    filters_figure as filters_figure,
    FlownAgain as FlownAgain,
    spectra_figure as spectra_figure,
    Spectrum as Spectrum,
    StepBand as StepBand,
    steps_figure as steps_figure,
    ThrottleCurve as ThrottleCurve,
)
from ._plane import nyquist as nyquist, pzmap as pzmap
from ._predictions import (
    compare as compare,
    resid as resid,
    Residuals as Residuals,
    residuals_of as residuals_of,
    step as step,
)
from ._tuning import (
    certificate_figure as certificate_figure,
    convergence_figure as convergence_figure,
    flight as flight,
    front_figure as front_figure,
)
