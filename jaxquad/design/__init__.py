"""Predicted accuracy of a test, and multisines optimised for it."""

from ._information import (
    AOptimal as AOptimal,
    certify_powers as certify_powers,
    Criterion as Criterion,
    DOptimal as DOptimal,
    information_per_energy as information_per_energy,
    LargestError as LargestError,
    MeasuredNoise as MeasuredNoise,
    noise_covariance as noise_covariance,
    optimal_powers as optimal_powers,
    PowerProblem as PowerProblem,
    Powers as Powers,
    predict_accuracy as predict_accuracy,
    Prediction as Prediction,
)
from ._optimal_multisine import (
    Design as Design,
    least_peak_phases as least_peak_phases,
    multisine_peaks as multisine_peaks,
    multisine_signals as multisine_signals,
    optimal_multisine as optimal_multisine,
)
