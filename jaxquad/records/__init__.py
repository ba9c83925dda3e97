from ._channel import Channel as Channel
from ._edit import detrend as detrend, mix as mix, select as select, trim as trim
from ._errors import (
    ReadError as ReadError,
    RecordError as RecordError,
    RecordWarning as RecordWarning,
)
from ._look import channels as channels, ChannelSummary as ChannelSummary
from ._proposal import Proposal as Proposal
from ._propose import propose as propose
from ._read import read as read
from ._record import Record as Record
from ._resample import resample as resample
