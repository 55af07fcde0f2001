"""The assembly of the kernels' inner loops on processors of several kinds, none of which has to be
at hand.

Numba's unoptimized IR of a loop is given to LLVM for another processor, through the passes that
Numba runs.
"""

import json
import re
import sys
from dataclasses import dataclass
from pathlib import Path

import numba
import numpy as np
import pytest
from blender.zips import output_of
from numba.core import config

from stga_addon.raster.cpu import FASTMATH, blend, image_loss, optimizer, splat_block

DRIVER = str(Path(__file__).with_name("compile_ir.py"))
X86 = "x86_64-unknown-linux-gnu"
ARM = "aarch64-unknown-linux-gnu"


@dataclass(frozen=True)
class Processor:
    """triple: LLVM's name of the architecture; vector: what only an instruction of full width
    names; packed: an arithmetic instruction on packed floats; scalar: one on a single float;
    conditional: a masked or scattered access.
    """

    triple: str
    vector: str
    packed: str
    scalar: str
    conditional: str


PACKED_X86 = r"\sv(add|sub|mul|div|sqrt|min|max|fn?m\w+)ps\s"
SCALAR_X86 = r"\sv(add|sub|mul|div|sqrt|min|max|fn?m\w+)ss\s"
MASKED_X86 = r"\svp?maskmov|\sv\w*(gather|scatter)|\sv\w*mov\w*\s.*\(.*\{%k"
AVX2 = Processor(X86, "%ymm", PACKED_X86, SCALAR_X86, MASKED_X86)
AVX512 = Processor(X86, "%zmm", PACKED_X86, SCALAR_X86, MASKED_X86)
NEON = Processor(
    ARM,
    r"\.4s",
    r"\sf\w+\s+v.*\.4s",
    r"\sf(add|sub|mul|div|sqrt|min|max|n?m\w+)\s+s\d",
    r"\s(ld|st)\d\s",
)
PROCESSORS = {"znver3": AVX2, "znver4": AVX512, "sapphirerapids": AVX2, "apple-m1": NEON}
"""LLVM prefers 256 bits on Sapphire Rapids, whose wider instructions lower the clock."""


def unoptimized_ir(function, signature, monkeypatch):
    """Numba's LLVM IR of a function, compiled as the kernels are but for the optimization.

    What it calls must be inlined by Numba (`inline_jit`): other functions would be kept,
    unoptimized, in the cache.
    """
    monkeypatch.setattr(config, "OPT", type(config.OPT)(0))
    python = getattr(function, "py_func", function)
    compiled = numba.njit(
        signature, fastmath=FASTMATH, error_model="numpy", no_cpython_wrapper=True
    )(python)
    ir = next(iter(compiled.inspect_llvm().values()))
    # Reference counting is in the form for this processor where this process has used it before.
    return re.sub(r"(?ms)^define linkonce_odr (\w+ @NRT_\w+)\(.*?^\}", r"declare \1(ptr)", ir)


def assemblies(ir):
    """Processor -> the IR compiled for it. Skips where this llvmlite was built without one of
    them."""
    asked = json.dumps(
        {"ir": ir, "targets": {cpu: kind.triple for cpu, kind in PROCESSORS.items()}}
    )
    found = json.loads(output_of([sys.executable, DRIVER], input=asked))
    missing = [cpu for cpu, text in found.items() if text is None]
    if missing:
        pytest.skip(f"this llvmlite was built without the target of {', '.join(missing)}")
    return found


def inner_loops(text):
    """The instructions of each loop that holds no other loop."""
    lines = text.splitlines()
    labels = {
        found[1]: n for n, line in enumerate(lines) if (found := re.match(r"(\.L\w+):", line))
    }
    jumps = (
        re.match(r"\s+(?:j\w+|b\.?\w*|cbn?z|tbn?z)\s+(?:.*,\s*)?(\.L\w+)", line) for line in lines
    )
    spans = [(labels[j[1]], n) for n, j in enumerate(jumps) if j and labels.get(j[1], n) < n]
    inner = [s for s in spans if not any(s != o and s[0] <= o[0] and o[1] <= s[1] for o in spans)]
    return [[line for line in lines[a : b + 1] if re.match(r"\s+[a-z]", line)] for a, b in inner]


def count(pattern, loop):
    return sum(bool(re.search(pattern, line)) for line in loop)


def faults(text, cpu, loops, spills):
    """What is wrong with the assembly of a function that should have so many vectorized inner
    loops, or nothing.

    spills: how many values, at most, each of them may keep in memory for want of registers.
    """
    kind = PROCESSORS[cpu]
    full = []
    for loop in inner_loops(text):
        if count(kind.packed, [line for line in loop if re.search(kind.vector, line)]):
            full.append(loop)
            if count(kind.conditional, loop):
                return f"{cpu}: a conditional load or store\n" + "\n".join(loop)
            if count(kind.scalar, loop):
                return f"{cpu}: scalar arithmetic in a vectorized loop\n" + "\n".join(loop)
            if (found := count("Spill|Reload", loop)) > spills:
                return f"{cpu}: {found} values in memory for want of registers\n" + "\n".join(loop)
    wrong = f"{cpu}: {len(full)} of {loops} loops are vectorized at full width"
    return "" if len(full) >= loops else wrong


STATE = "f4[::1]"
PIXELS = "u8, u8"
LIST = "u2[::1]"
LIMITS = "UniTuple(f4, 4)"
TABLE = np.zeros((2, 3), np.float32)
ADAM = numba.types.void(
    *[numba.typeof(np.zeros(2, np.int32))] * 2,
    numba.typeof(optimizer.AdamTables(*[TABLE] * 5, TABLE[0])),
    *[numba.typeof(TABLE)] * 2,
    numba.typeof(optimizer.AdamOptions(*np.zeros(5, np.float32))),
)
ROW = numba.float32[::1]
ROWS = numba.typeof(image_loss._Rows(*[np.zeros(2, np.float32)] * 9))
COLUMNS = numba.typeof(image_loss._Columns(*[0] * 6))
WEIGHTS = numba.types.UniTuple(numba.float32, 2)
LOOPS = {
    "falloff": (blend._falloff, f"void(u8, {LIST}, {STATE}, b1, {STATE})", 1, 8),
    "blend": (blend._blend, f"void(u8, {LIST}, i8, {STATE}, {STATE})", 1, 4),
    "unblend": (blend._unblend, f"void(u8, {LIST}, i8, {STATE}, {STATE})", 1, 4),
    "gradient of a splat": (blend._sum_gradient, f"void({PIXELS}, {STATE}, {STATE})", 1, 0),
    "horizontal blur": (image_loss._blur_row, f"void({STATE}, i8, {STATE}, i8, i8)", 1, 0),
    "vertical blur": (
        image_loss._blur_column,
        numba.types.void(ROW, numba.int64, numba.int64, ROW, COLUMNS),
        1,
        0,
    ),
    "SSIM": (image_loss._similarity_row, numba.types.void(ROWS, COLUMNS), 1, 8),
    "gradient of the loss": (
        image_loss._gradient_row,
        numba.types.void(ROW, ROW, numba.int64, ROWS, COLUMNS, WEIGHTS),
        1,
        4,
    ),
    "Adam": (optimizer.adam_block, ADAM, 2, 1),
    "projection": (splat_block.project_geometry, f"void({STATE}, {STATE}, {LIMITS})", 1, 82),
    "bounds in tiles": (splat_block.project_bounds, f"void({STATE}, f4, f4)", 1, 12),
    "harmonics": (splat_block.compute_harmonics, f"void({STATE}, f4[:, ::1])", 1, 20),
    "gradient of the projection": (
        splat_block.differentiate_geometry,
        f"void({STATE}, {STATE}, {LIMITS}, UniTuple(f4, 2), f4)",
        1,
        232,
    ),
    "gradient of the harmonics": (
        splat_block.differentiate_position,
        f"void({STATE}, f4[:, ::1])",
        1,
        52,
    ),
}
"""name -> function, signature, its vectorized loops, and the spills that each may have"""


@pytest.mark.nightly
@pytest.mark.parametrize("name", LOOPS)
def test_inner_loops_are_vectorized_on_every_processor(name, monkeypatch):
    """Catches a change that leaves a hot loop scalar, half as wide, with masked stores or with
    spills on a processor other than the one that it was tuned on."""
    function, signature, loops, spills = LOOPS[name]
    compiled = assemblies(unoptimized_ir(function, signature, monkeypatch))
    found = [fault for cpu, text in compiled.items() if (fault := faults(text, cpu, loops, spills))]
    assert not found, f"{name}\n" + "\n".join(found)


def with_conditional_store(s, order, limit):
    for p in range(np.uint64(256)):
        t = s[p] * order
        s[p + np.uint64(256)] = order if t > limit else s[p + np.uint64(256)]


def test_the_check_finds_what_it_looks_for(monkeypatch):
    """Catches a check that passes whatever the assembly holds."""
    signature = f"void({STATE}, f4, f4)"
    compiled = assemblies(unoptimized_ir(with_conditional_store, signature, monkeypatch))
    assert all(faults(compiled[cpu], cpu, 1, 0) for cpu in ("znver3", "apple-m1"))
