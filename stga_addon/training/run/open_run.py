"""Opening a run together with the capture that it was trained on."""

from dataclasses import dataclass, replace
from pathlib import Path

from ...capture.model import Capture, join_takes
from ...capture.open import open_capture
from ...errors import StgaError
from ...render.device import GPU, adapter_names, choose_device
from .folder import Run, Take, has_run, read_run
from .identity import RunIdentity, difference, identity_of, version_4_identity
from .tracking_file import with_refined_tracking


@dataclass(frozen=True)
class OpenedRun:
    """A run and its capture. `run` has the paths of `capture` and FLAME model that were opened.

    takes  the captures that `capture` is joined from
    """

    run: Run
    capture: Capture
    takes: tuple[Capture, ...]


def open_run(
    folder: Path, capture: Path | None = None, flame: Path | None = None, principal_point: str | None = None
) -> OpenedRun:
    """Open the run in `folder`; the other arguments stand in for what it was trained with.

    A capture or a FLAME model may have moved, but not changed; tracked meshes may be refined.
    Raises StgaError in one sentence where the folder holds no run or anything differs from what it was trained with.
    """
    run = read_run(folder)
    if principal_point not in (None, run.principal_point):
        raise StgaError(f"{folder}: was trained with principal point '{run.principal_point}', not '{principal_point}'")
    flame = run.flame if flame is None else flame.resolve()
    first = open_capture(run.capture if capture is None else capture, flame, run.principal_point)
    run = replace(run, capture=first.root, flame=flame)
    takes = (first, *(_open_take(folder, run, take) for take in run.takes))
    opened = join_takes(takes)
    check_identity(folder, run, opened)
    if run.continuation is not None:  # it was trained on the meshes that the run before has refined
        opened = with_refined_tracking(opened, folder)
    return OpenedRun(run, opened, takes)


def open_refined(folder: Path, capture: Path | None = None, flame: Path | None = None) -> Capture:
    """The capture of a run, with the FLAME parameters that the run refined. Errors as of `open_run`."""
    if not folder.is_dir():
        raise StgaError(f"{folder}: is not a folder; expected that of a run")
    return with_refined_tracking(open_run(folder, capture, flame).capture, folder)


def _open_take(folder: Path, run: Run, take: Take) -> Capture:
    """A capture that joined the run. Raises StgaError where it is missing or has changed."""
    capture = open_capture(take.capture, run.flame, run.principal_point)
    changed = difference(take.identity, identity_of(capture, run.principal_point, run.settings))
    if changed is not None:
        raise StgaError(f"{folder}: was extended with {take.capture} ({take.identity.summary}), but it now {changed}")
    return capture


def check_identity(folder: Path, run: Run, capture: Capture) -> RunIdentity:
    """The identity of `run` on `capture`, as the folder's files carry it.

    Raises StgaError where the folder holds a run that was begun with another one; the sentence names both sides.
    """
    given = identity_of(capture, run.principal_point, run.settings)
    if not has_run(folder):
        return given
    stored = read_run(folder)
    trained = stored.identity
    if trained is None or trained == given:  # None: the run was prepared, but has not begun
        return given
    if trained == version_4_identity(given, run.settings):
        return trained
    if trained.principal_point != given.principal_point:
        wanted = f"principal point '{trained.principal_point}', not '{given.principal_point}'"
        raise StgaError(f"{folder}: was trained with {wanted}; train into another folder")
    if "" not in (trained.flame, given.flame) and trained.flame != given.flame:
        wanted = f"FLAME model {stored.flame}, but {run.flame} has other content"
        raise StgaError(f"{folder}: was trained with {wanted}; train into another folder")
    changed = difference(trained, given)
    if changed is not None:
        where = "it now" if capture.root == stored.capture else f"{capture.root} ({given.summary})"
        wanted = f"{stored.capture} ({trained.summary}), but {where} {changed}"
        raise StgaError(f"{folder}: was trained on {wanted}; train into another folder")
    raise StgaError(f"{folder}: was begun with other settings; restore them in run.json, or train into another folder")


def device_of(run: Run, requested: str = "auto") -> tuple[str, str]:
    """The device to continue a run on, and why: its own, unless `requested` names another (`choose_device`).

    A run of a GPU that this machine lacks continues on the first one.
    Raises StgaError where that device does not work or cannot train this run.
    """
    trained_on = run.device if _has(run.device) else run.device.partition(":")[0]
    try:
        device, reason = choose_device(trained_on if requested == "auto" else requested)
    except StgaError as error:
        if requested != "auto":
            raise
        raise StgaError(
            f"this run was trained on {trained_on}: {error}; give --device cpu to continue on the CPU"
        ) from error
    if run.settings.tracking and device != "cpu":
        raise StgaError(f"--device {requested}: this run refines the tracking, which works on the CPU only")
    return device, reason


def _has(device: str) -> bool:
    """Whether a device is a GPU by the name of an adapter of this machine."""
    try:
        return device.startswith(GPU) and device.removeprefix(GPU) in adapter_names()
    except StgaError:  # no GPU at all
        return False
