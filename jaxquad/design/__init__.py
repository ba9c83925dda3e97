from ._criteria import (
    AOptimal as AOptimal,
    Criterion as Criterion,
    DOptimal as DOptimal,
    LargestError as LargestError,
)
from ._noise import MeasuredNoise as MeasuredNoise
from ._optimal_multisine import Design as Design, optimal_multisine as optimal_multisine
from ._prediction import predict_accuracy as predict_accuracy, Prediction as Prediction
