"""Render server: `python -m stga_addon.raster.render_server` answers render requests on its pipes."""

import sys
from typing import Any

from ..capture.camera import Camera
from ..worker.environment_use import mark_environment_used
from .cpu.compose import compose
from .posed_splats import PosedSplats
from .render_protocol import receive, send, unpack_layers


def serve(requests: Any, answers: Any) -> None:
    """Answer until the other side is gone; layers stay until others come."""
    layers: list[PosedSplats] = []
    while True:
        try:
            request = receive(requests)
        except EOFError:
            return
        try:
            if "layers" in request:
                layers = unpack_layers(request)
            width, height, fl_x, fl_y, cx, cy = request["camera"].tolist()
            camera = Camera(int(width), int(height), fl_x, fl_y, cx, cy, request["pose"])
            picture = compose(layers, camera, bool(request["with_depth"]))
            answer: dict[str, Any] = {"rgb": picture.rgb, "alpha": picture.alpha}
            if picture.depth is not None:
                answer["depth"] = picture.depth
        except Exception as error:  # the one who asked shall hear it, whatever it is
            answer = {"error": f"{type(error).__name__}: {error}"}
        send(answers, answer)


if __name__ == "__main__":
    mark_environment_used()
    pipe, sys.stdout = sys.stdout.buffer, sys.stderr  # nothing else may get between the messages
    serve(sys.stdin.buffer, pipe)
