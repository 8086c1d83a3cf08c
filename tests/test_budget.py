"""How large the programs are that a user waits for: planning, a picture and its gradient. To grow
beyond the committed table is a decision: `SPLATJAX_BUDGET=write` rewrites it.
"""

import json
import os
import re
from importlib.metadata import version
from pathlib import Path

import jax
import jax.numpy as jnp
import pytest

import splatjax as sj

TABLE, LOCK = (
    Path(__file__).with_name("budget.json"),
    Path(__file__).parents[1] / "requirements.lock",
)
SPARE = 1.01  # so little is no decision


def size_of(function, *given) -> dict[str, int]:
    """Count the distinct computations of a compiled program, and the instructions of all."""
    text = jax.jit(function).lower(*given).compile().as_text()
    text = re.sub(r", metadata=\{[^}]*\}|[\w.\-]+(?=: )|%[\w.\-]+", "", text)
    fused = {body for body in text.split("\n\n") if "ROOT" in body and "ENTRY" not in body}
    return {"distinct computations": len(fused), "instructions": text.count(" = ")}


@pytest.mark.once
def test_programs_are_within_the_committed_budget(compiled):
    splats, material = sj.bust(4_000).scaled(0.2), sj.load_material("skin")
    scene = sj.Scene(splats, [sj.DirectionalLight([0.5, -0.5, -1.0], jnp.ones(3))], material)
    camera = sj.Camera.look_at((66, 4, 140), (0, -9, 0), fov=30, width=64, height=64)
    jax.clear_caches()
    compiled.clear()
    plan = sj.make_plan(scene, camera)
    found = {"planning": {"programs": len(compiled)}}

    def picture(scene):
        return sj.render(scene, camera, plan=plan).beauty

    found["picture"] = size_of(picture, scene)
    found["gradient"] = size_of(jax.grad(lambda scene: jnp.mean(picture(scene))), scene)
    if os.environ.get("SPLATJAX_BUDGET") == "write":
        TABLE.write_text(json.dumps({"jaxlib": version("jaxlib"), **found}, indent=2) + "\n")
    table = json.loads(TABLE.read_text())
    # Where another jaxlib is locked, the table is rewritten.
    assert f"jaxlib=={table['jaxlib']} " in LOCK.read_text(), "count again: SPLATJAX_BUDGET=write"
    if table["jaxlib"] != version("jaxlib"):
        pytest.skip(f"the budget was counted with jaxlib {table['jaxlib']}")
    grown = [
        f"{name}: {count} {what}, of {table[name][what]}"
        for name, counts in found.items()
        for what, count in counts.items()
        if count > SPARE * table[name][what]
    ]
    assert not grown, "; ".join(grown)
