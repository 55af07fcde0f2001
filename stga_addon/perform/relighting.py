"""The light of a run's capture, kept in its avatar."""

from dataclasses import replace
from pathlib import Path

import numpy as np

from ..avatar.file import AvatarLight, read_avatar, write_avatar
from ..capture.camera import central_camera
from ..capture.color import srgb_to_linear
from ..capture.model import Capture
from ..errors import StgaError
from ..light.environment import harmonics_of, read_hdr
from ..light.estimate import Known, estimate_light
from ..progress import Report, Say, ignore
from ..requests.results import Written
from ..requests.values import Relight
from ..training.evaluate.match_exposure import known_exposure
from ..training.run.folder import AVATAR, locked
from ..training.run.open_run import open_refined


def relight(request: Relight, report: Report, say: Say) -> Written:
    """Estimate the light, or take the known one, and write it into the run's avatar file. Raises StgaError."""
    folder = request.run
    capture = open_refined(folder, request.capture, request.flame)
    known = Known()
    if request.light is not None:
        known = Known(radiance=harmonics_of(read_hdr(request.light)))
    elif request.card is not None:
        card = srgb_to_linear(np.array(request.card))
        if not card.min() > 0:
            raise StgaError(f"--gray-card: expected three numbers above 0, got {request.card}")
        known = Known(card=card[None], toward=_toward_central_camera(capture)[None])
    return Written(folder / AVATAR, add_light(folder / AVATAR, capture, known, report))


def add_light(avatar_file: Path, capture: Capture, known: Known = Known(), report: Report = ignore) -> tuple[str, ...]:  # noqa: B008
    """Write the light of a capture into a run's avatar file; returns what there is to say.

    Raises StgaError, also while another process trains or lights the run.
    """
    with locked(avatar_file.parent):
        avatar = read_avatar(avatar_file)
        exposure = known_exposure(avatar.settings.get("exposure") or (), ())
        light = estimate_light(capture, replace(known, exposure=exposure), report)
        write_avatar(avatar_file, replace(avatar, light=light))
    return describe_light(light)


def describe_light(light: AvatarLight) -> tuple[str, ...]:
    """Lines about where a light is from and how well it explains the capture."""
    source = {"estimated": "estimated", "gray_card": "estimated, level by a gray card", "file": "from a file"}
    line = f"light: {source[light.source]}; recorded colors differ from it by {light.residual:.1%}"
    if not light.damping:
        return (line,)
    damped = f"albedo is pulled to its mean by {light.damping:.0%} (docs/light.md)"
    return line, f"warning: the capture's light is too hard to be taken away; {damped}"


def _toward_central_camera(capture: Capture) -> np.ndarray:
    """(3,) from the face to the camera that sees it from the front."""
    first = {view.camera_index: view.camera for views in capture.views.values() for view in views}
    if not first:
        raise StgaError(f"{capture.root}: has no camera that a gray card could face")
    cameras = list(first.values())
    offset = cameras[central_camera(cameras)].position - capture.neutral.mean(0)
    return np.asarray(offset / np.linalg.norm(offset))
