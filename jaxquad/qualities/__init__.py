from ._bandwidth import attitude_bandwidth as attitude_bandwidth, Bandwidth as Bandwidth
from ._margins import Margins as Margins, margins as margins
from ._rejection import disturbance_rejection as disturbance_rejection, Rejection as Rejection
from ._rms import rms_response as rms_response, RmsResponse as RmsResponse
