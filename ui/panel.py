"""The sidebar tab: Track → Capture → Select → Train → Show → Motion."""

from ..operators.common import AtEnd, register_classes
from . import motion_panel, next_step, select_panel, show_panel, sidebar, track_panel, train_panel

CLASSES = (
    next_step.NextStepPanel,
    track_panel.TrackPanel,
    track_panel.TrackOptionsPanel,
    track_panel.TrackCheckPanel,
    select_panel.CapturePanel,
    select_panel.SelectedFrames,
    select_panel.SelectPanel,
    train_panel.TrainPanel,
    train_panel.TrainOptionsPanel,
    train_panel.ContinuePanel,
    train_panel.EffectsPanel,
    show_panel.ShowPanel,
    show_panel.LightingPanel,
    motion_panel.MotionPanel,
    motion_panel.PosesPanel,
    motion_panel.FacePanel,
    motion_panel.DrivePanel,
    motion_panel.TrainedPanel,
    motion_panel.CoefficientsPanel,
    show_panel.RenderPanel,
)
"""Classes in the order of the tab."""


def register(at_end: AtEnd) -> None:
    sidebar.register(at_end)
    register_classes(CLASSES, at_end)
    show_panel.register(at_end)
