from ._channel import Channel as Channel, clock_start as clock_start, show_times as show_times
from ._edit import resample as resample, select as select, trim as trim
from ._interop import read_struct as read_struct
from ._log import (
    ReadError as ReadError,
    RecordError as RecordError,
    RecordWarning as RecordWarning,
)
from ._proposal import (
    AXES as AXES,
    Flight as Flight,
    flights as flights,
    Proposal as Proposal,
    propose as propose,
)
from ._read import (
    Mix as Mix,
    MixError as MixError,
    other_axes as other_axes,
    parse_mix as parse_mix,
    read as read,
    read_segments as read_segments,
    Segment as Segment,
)
from ._record import Record as Record
from ._timebase import channels as channels, ChannelSummary as ChannelSummary
from ._traces import envelope as envelope, traces as traces
from .firmware import read_settings as read_settings, Settings as Settings
from .formats import (
    channel_names as channel_names,
    keep_logs as keep_logs,
    require_file as require_file,
)
