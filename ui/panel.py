"""The sidebar tab: Track → Capture → Select → Train → Show → Motion."""

from ..operators.common import register_classes, unregister_classes
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
    motion_panel.FacePanel,
    motion_panel.DrivePanel,
    motion_panel.TrainedPanel,
    motion_panel.CoefficientsPanel,
    show_panel.RenderPanel,
)


def register() -> None:
    sidebar.register()
    register_classes(CLASSES)
    show_panel.register()


def unregister() -> None:
    show_panel.unregister()
    unregister_classes(CLASSES)
    sidebar.unregister()
