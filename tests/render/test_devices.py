"""Eight devices give what one gives, and send each other what the model predicts. They need their
own process. Same input, same bits: in another process, on another number of processors.
"""

import json
import os
import runpy
from pathlib import Path

import pytest
from processes import free_port, run_together

HERE = Path(__file__).parent
ROUNDING = 3e-5  # of the largest number of its kind: sums of a thousand terms, in another order


def answers(commands, devices):
    """Run scripts beside each other, each with so many devices; give what they print."""
    flags = f"--xla_force_host_platform_device_count={devices} {os.environ.get('XLA_FLAGS', '')}"
    environment = {
        "XLA_FLAGS": flags,
        "JAX_PLATFORMS": "cpu",
    }
    statuses, printed, errors = run_together(*((words, environment) for words in commands))
    assert not any(statuses), errors
    return [json.loads(out.splitlines()[-1]) for out in printed]


def on_eight(question):
    return answers([[HERE / "over_devices.py", question]], 8)[0]


# The picture and the gradients; what else is made of splats that are cut; views of many cameras.
@pytest.mark.parametrize(
    "question",
    [
        "light_and_unshadowed_splats_cut",
        pytest.param("splats_cut", marks=pytest.mark.long),
        pytest.param("more_than_pictures_cut", marks=pytest.mark.long),
        pytest.param("views_cut", marks=pytest.mark.long),
    ],
)
def test_eight_devices_find_what_one_finds(question):
    errors = on_eight(question)
    assert len(errors) > 20
    assert max(errors.values()) < ROUNDING, errors


@pytest.mark.long
def test_devices_send_each_other_what_the_model_says():
    answer = on_eight("traffic")
    for kind, model in answer["model"].items():
        assert answer["counted"][kind] == pytest.approx(model, rel=0.1), (kind, answer)


@pytest.mark.long
@pytest.mark.parametrize(("what", "count"), [("picture", 2), ("gradients", 4)])
def test_splats_of_several_processes_make_what_those_of_one_do(what, count):
    port = free_port()
    found = answers(
        [[HERE / "over_devices.py", "over_processes", what, i, count, port] for i in range(count)],
        4 // count,
    )
    for answer in found:
        assert answer["devices"] == 4
        assert answer["rows"] == ([376] * (4 // count) if what == "gradients" else [])
    assert max(found[0]["apart"].values()) < ROUNDING, found[0]


@pytest.mark.long
def test_everything_is_the_same_on_one_processor_and_on_all():
    digests = runpy.run_path(str(HERE.parents[1] / "tools" / "same_bits.py"))["in_a_process"]
    everyone = os.sched_getaffinity(0)
    assert digests({min(everyone)}) == digests(everyone)
