from ._flights import (
    again_figure as again_figure,
    b0_figure as b0_figure,
    balance_figure as balance_figure,
    channels_of as channels_of,
    extremes as extremes,
    filters_figure as filters_figure,
    FlownAgain as FlownAgain,
    histories as histories,
    record_figure as record_figure,
    ROWS as ROWS,
    spectra_figure as spectra_figure,
    spectrogram as spectrogram,
    Spectrum as Spectrum,
    StepBand as StepBand,
    steps_figure as steps_figure,
    ThrottleCurve as ThrottleCurve,
)
from ._panels import (
    add_hertz as add_hertz,
    COHERENT as COHERENT,
    headless as headless,
    Panels as Panels,
    plain_ticks as plain_ticks,
    short_names as short_names,
    unit_label as unit_label,
    visible as visible,
)
from ._predictions import (
    compare as compare,
    resid as resid,
    Residuals as Residuals,
    residuals_of as residuals_of,
    step as step,
)
from ._responses import bode as bode, coherence as coherence, nyquist as nyquist, pzmap as pzmap
from ._tuning import (
    certificate_figure as certificate_figure,
    convergence_figure as convergence_figure,
    flight as flight,
    front_figure as front_figure,
)
