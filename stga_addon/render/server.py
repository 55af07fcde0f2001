"""Render server: `python -m stga_addon.render.server DEVICE` answers render requests, stdin to stdout."""

import sys
from typing import BinaryIO

from ..worker.helpers import claim_stdout


def serve(requests: BinaryIO, replies: BinaryIO, device: str) -> None:
    """Answer requests until the stream ends; layers are kept until a request brings others.

    device: as `Composer` takes it.
    """
    from ..capture.camera import Camera
    from ..errors import StgaError
    from ..raster.posed_splats import PosedSplats
    from .compose import Composer
    from .protocol import receive, send, unpack_layers

    layers: list[PosedSplats] = []
    composer = Composer(device)
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
            image = composer.compose(layers, camera, bool(request["with_depth"]))
        except Exception as error:  # the client reports it, whatever it is
            kind = "" if isinstance(error, StgaError) else f"{type(error).__name__}: "
            send(replies, {"error": f"{kind}{error}"})
        else:
            depth = {} if image.depth is None else {"depth": image.depth}
            send(replies, {"rgb": image.rgb, "alpha": image.alpha, "failure": composer.failure, **depth})


if __name__ == "__main__":
    replies = claim_stdout()
    serve(sys.stdin.buffer, replies, sys.argv[1])
