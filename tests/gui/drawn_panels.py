"""The panels of the sidebar as their layouts are filled, and the buttons in them."""

import bpy
from in_window import in_viewport, module, viewport
from layouts import filled

PANEL_MARGIN = 36
"""Of a sidebar's width: tabs, and the borders of panel and sub-panel."""


def draw(panel):
    """What a panel draws now."""
    with in_viewport("UI"):  # which has a width
        return filled(panel, bpy.context)


def drawn():
    """Label of each panel that is to be seen -> what is drawn in it."""
    with in_viewport("UI"):
        return {
            panel.bl_label: draw(panel)
            for panel in module("ui.panel").CLASSES
            if issubclass(panel, bpy.types.Panel)
            and getattr(panel, "poll", lambda context: True)(bpy.context)
        }


def buttons():
    """ "Panel: text" of each button in sidebar, menus and preferences -> operator and options."""
    operators = module("operators")
    found = {
        f"{menu}: {text}": (operator, {})
        for menu, entries in (("Import", operators.IMPORTS), ("Export", operators.EXPORTS))
        for operator, text in entries
    }
    preferences = draw(module("ui.properties").Preferences)
    for panel, layout in {**drawn(), "Preferences": preferences}.items():
        for leaf in layout.leaves:
            if leaf.kind == "operator":
                text = leaf.text or leaf.options.get("icon")
                found[f"{panel}: {text}"] = leaf.arguments[0], vars(leaf.button)
            elif leaf.kind == "operator_menu_enum":
                name, option = leaf.arguments
                kind = getattr(bpy.ops.stga, name.split(".")[1]).get_rna_type()
                for item in kind.properties[option].enum_items:
                    found[f"{panel}: {item.name}"] = name, {option: item.identifier}
    return found


def cut_texts():
    """ "Panel: text" of each row that is wider than the sidebar -> its width, and the room; none
    where the sidebar is closed."""
    scale = bpy.context.preferences.system.ui_scale
    room = viewport("UI")[2].width / scale - PANEL_MARGIN
    return {
        f"{panel}: {row.text}": [round(row.width), round(room)]
        for panel, layout in drawn().items()
        for row in layout.items
        if row.width > room > 0
    }
