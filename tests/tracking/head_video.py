"""A video of a generated head whose face the networks find."""

import numpy as np
from flame.small_head import small_head
from scipy.spatial.transform import Rotation

from stga_addon.render.video import video_writer
from stga_addon.tracking.correspondence import picture_cameras, shaded_image


def write_head_video(path, frames, size=256):
    """The head turns from side to side before a camera that stands still; returns its focal length
    in pixels."""
    model = small_head(0)
    front = picture_cameras(model.v_template)[0]
    camera = front.scaled(size / front.width)
    center = model.v_template.mean(axis=0)
    with video_writer(path, 25) as write:
        for degrees in np.linspace(-20, 20, frames):
            turn = Rotation.from_euler("y", degrees, degrees=True)
            turned = turn.apply(model.v_template - center) + center
            write(shaded_image(turned, model.faces, camera))
    return camera.fl_x
