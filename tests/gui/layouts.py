"""A stand-in for the layout that a panel fills: texts, buttons, and the width that they need."""

from types import SimpleNamespace
from typing import Any

import blf
import bpy

PADDING = 8
ICON = 20
NUMBER = 40
"""Around a text in its button, an icon, and the value in a field, in pixels at a resolution scale
of 1, as all widths."""
NESTED = ("row", "column", "box", "split", "grid_flow", "column_flow")


class Layout:
    """Takes the place of a panel's layout, and keeps what is drawn."""

    def __init__(self, kind="column", **options):
        self.kind = kind
        self.options = options
        self.items = list[Any]()

    def __getattr__(self, kind):
        if kind.startswith("__"):
            raise AttributeError(kind)

        def draw(*arguments, **options):
            nested = kind in NESTED
            self.items.append(Layout(kind, **options) if nested else Leaf(kind, arguments, options))
            return self.items[-1] if nested else self.items[-1].button

        return draw

    @property
    def leaves(self):
        return [leaf for item in self.items for leaf in item.leaves]

    @property
    def text(self):
        return " ".join(leaf.text for leaf in self.leaves)

    is_icon = False

    @property
    def cells(self):
        rows = [item.cells if item.kind == "row" else [item] for item in self.items]
        return [cell for row in rows for cell in row]

    @property
    def width(self):
        """That the texts need."""
        widths = [item.width for item in self.items] or [0.0]
        if self.kind == "row":  # whose items, also those of rows in it, are equally wide, but icons
            wide = [cell.width for cell in self.cells if not cell.is_icon]
            icons = [cell.width for cell in self.cells if cell.is_icon]
            return len(wide) * max(wide, default=0.0) + sum(icons)
        if self.kind == "split":
            return widths[0] / self.options.get("factor", 0.5)
        return max(widths) * max(self.options.get("columns", 1), 1)


class Leaf:
    """A label, field or button, with its width: that of the text, the icon and the value."""

    def __init__(self, kind, arguments, options):
        self.kind = kind
        self.arguments = arguments
        self.options = options
        self.leaves = [self]
        self.button = SimpleNamespace()
        self.text = ""
        self.is_number = False
        if kind == "operator":
            group, name = arguments[0].split(".")
            self.text = getattr(getattr(bpy.ops, group), name).get_rna_type().name
        elif kind in ("prop", "prop_search") and hasattr(arguments[0], "bl_rna"):
            field = arguments[0].bl_rna.properties.get(arguments[1])
            if field is not None:  # no custom property
                self.text = field.name
                self.is_number = field.type in ("INT", "FLOAT")
        self.text = options.get("text", self.text)
        self.is_icon = kind == "operator" and not self.text

    @property
    def width(self):
        blf.size(0, bpy.context.preferences.ui_styles[0].widget.points)
        place = "Operator" if self.kind == "operator" else "*"
        shown = bpy.app.translations.pgettext_iface(self.text, place)
        text = blf.dimensions(0, shown)[0] + PADDING if self.text else 0.0
        has_icon = self.options.get("icon", "NONE") != "NONE" or "icon_value" in self.options
        return float(text + (ICON if has_icon else 0) + (NUMBER if self.is_number else 0))


def filled(panel, context):
    """What a panel draws; Blender makes panels itself, in a window only."""
    own = [vars(base) for base in reversed(panel.__mro__) if ".ui." in base.__module__]
    members = {name: thing for part in own for name, thing in part.items() if name[:2] != "__"}
    stand_in = type(panel.__name__, (), members)()
    stand_in.layout = Layout()
    stand_in.draw(context)
    return stand_in.layout  # type: ignore[no-any-return]
