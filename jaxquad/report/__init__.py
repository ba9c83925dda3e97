from ._comparison import comparison as comparison
from ._html import write_report as write_report
from ._html_page import page as page
from ._html_provenance import Provenance as Provenance, provenance as provenance, Source as Source
from ._html_text import (
    element as element,
    given as given,
    Html as Html,
    joined as joined,
    section as section,
    table as table,
)
from ._results import (
    plain_content as plain_content,
    verification_content as verification_content,
    write_json as write_json,
    write_results as write_results,
)
