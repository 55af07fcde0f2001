"""Selection of triangles as requests ask for it."""

from ..capture.open import open_capture
from ..progress import Report, Say
from ..requests.results import Selected
from ..requests.values import Select
from ..selection import SelectionOptions, select_capture


def select(request: Select, report: Report, say: Say) -> Selected:
    """Select by the rule; says how much each timestep selects, and which regions as a whole. Raises StgaError."""
    capture = open_capture(request.capture, request.flame, request.principal_point)
    options = SelectionOptions(request.threshold, request.zero_pose or SelectionOptions.zero_pose)
    selection = select_capture(capture, options)
    say(f"threshold {1000 * request.threshold:g} mm, {len(capture.faces)} triangles")
    for timestep, faces in selection.items():
        regions = [name for name, members in capture.regions.items() if members.any() and faces[members].all()]
        say(f"{timestep:5d}  {faces.mean():6.1%}  {', '.join(regions)}")
    return Selected(selection)
