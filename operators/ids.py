"""Every id that this extension registers, in one place."""

IMPORT_CAPTURE = "stga.import_capture"
SELECT = "stga.select"
TRAIN = "stga.train"
SHOW_AVATAR = "stga.show_avatar"
IMPORT_PLY = "stga.import_ply"
EXPORT = "stga.export"
STANDARD_VIEW = "stga.standard_view"

SETTINGS = "stga"  # property group on the scene
CLI_COMMAND = "stga"
