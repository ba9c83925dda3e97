from ._bode import bode as bode
from ._certificate import certificate_figure as certificate_figure
from ._comparison import comparison as comparison
from ._convergence import convergence_figure as convergence_figure
from ._front import front_figure as front_figure
from ._histories import histories as histories
from ._html import write_report as write_report
from ._html_provenance import Provenance as Provenance, provenance as provenance, Source as Source
from ._json import write_json as write_json
from ._overlay import overlay as overlay, record_figure as record_figure
from ._results import write_results as write_results
