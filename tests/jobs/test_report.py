import dataclasses
import json
import math
import re
from html.parser import HTMLParser
from itertools import islice
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from matplotlib.figure import Figure
from mcap.records import Chunk, McapRecord
from mcap.stream_reader import breakup_chunk

import gripper_force as gf
from gripper_force.config import config_from, dump_config
from gripper_force.errors import LogError, NonFiniteError
from gripper_force.jobs import report as report_module
from gripper_force.jobs.report import pictures as pictures_module
from gripper_force.jobs.report import reading as reading_module
from gripper_force.jobs.report import write_report
from gripper_force.jobs.report.figure import CSS_COLOURS, draw, histogram, with_gaps
from gripper_force.jobs.report.pictures import FrameSampler, Picture, overlay
from gripper_force.jobs.report.reading import read_run
from gripper_force.jobs.report.run import SOURCES, Run, Series
from gripper_force.jobs.score import HoldVision, VisionLoss
from gripper_force.runtime import log_reader as log_reader_module
from gripper_force.runtime.log_reader import LogReader
from gripper_force.runtime.log_writer import LogWriter
from gripper_force.types import (
    NS_PER_MS,
    NS_PER_S,
    EstimateSource,
    Event,
    Frame,
    FusedForce,
    GraspStatus,
    Gray,
    LoadCellSample,
    Record,
    Request,
    RequestKind,
    ServoCommand,
    ServoState,
    VisualForce,
)
from gripper_force.vision.checkpoint import load_checkpoint
from gripper_force.vision.checkpoint_writer import save_checkpoint
from gripper_force.vision.estimator import ForceEstimator
from gripper_force.vision.header import Header, NetworkConfig, Residual
from gripper_force.vision.network import ForceNetwork
from gripper_force.vision.preprocess import Preprocess

TARGET_N = 4.0
START_NS = 5 * NS_PER_S
"""When the log starts; the request comes 0.5 s later."""
PHASES = [(0.0, "open"), (0.5, "approach"), (1.1, "contact"), (1.4, "ramp"), (2.2, "hold"), (5.0, "release")]


def force_n(t_s: float) -> float:
    """Force of the load cell: contact, a ramp with some overshoot, hold, release."""
    overshoot = 0.35 * np.exp(-((t_s - 2.35) ** 2) / 0.01)
    return float(
        np.interp(t_s, [1.1, 1.4, 2.2, 5.0, 5.4], [0, 0.5, TARGET_N, TARGET_N + 0.05, 0]) + overshoot
    )


def test_a_refused_request_has_no_score(quick: list[str], tmp_path: Path) -> None:
    path = tmp_path / "refused.mcap"
    with gf.open_gripper(overrides=[*quick, "camera.backend=none"], log=path) as gripper:
        gripper.grasp(3.0)
        with pytest.raises(gf.RequestError, match="an object is held"):
            gripper.grasp(2.0, new_object=True)
        gripper.sleep(0.2)
    run = read_run(LogReader(path))
    assert run.target_n == 3.0
    assert any(row.text.startswith("refused") for row in run.event_rows)


def test_a_report_scores_the_last_request_alone(quick: list[str], tmp_path: Path) -> None:
    scores = []
    for name, second_n in (("lowered", 2.0), ("released", 6.0)):
        with gf.open_gripper(overrides=quick, log=tmp_path / f"{name}.mcap") as gripper:
            gripper.grasp(4.0)
            if name == "lowered":
                gripper.set_force(second_n)
            else:
                gripper.release()
                gripper.grasp(second_n, wait=False)
            gripper.sleep(0.5)
            gripper.release()
        run = read_run(LogReader(tmp_path / f"{name}.mcap"))
        assert run.target_n == second_n
        scores.append((run.outcome, run.score))
    (outcome, lowered), (none, nothing) = scores
    assert (outcome, none, nothing) == ("held", "", None)
    assert lowered is not None
    assert lowered.steady_n == pytest.approx(2.0, abs=0.4)
    assert lowered.overshoot_n < 0.5, "the 4 N before the request are none"


def picture(force: float) -> Gray:
    """An image of a blob that spreads with the force, before a pattern that shows that the camera stays."""
    y, x = np.mgrid[-1:1:128j, -1:1:128j]
    pattern = 60 + 25 * x + 8 * np.sin(40 * x) * np.sin(37 * y)
    return np.asarray(pattern + 120 * np.exp(-(x**2 + y**2) / (0.02 + 0.01 * force)), np.uint8)


REAL = {
    "servo": {"port": "/dev/ttyUSB0"},
    "camera": {"backend": "uvc"},
    "load_cell": {"backend": "serial"},
    "clock": "realtime",
}
"""Configuration of a rig that is not simulated."""


def write_grasp(
    path: Path,
    *,
    checkpoint: Path | None = None,
    digest: str = "",
    real: bool = True,
    lost_s: float = math.inf,
) -> Path:
    """A plausible grasp: control at 100 Hz, camera at 30 Hz, load cell at 100 Hz; without vision from ``lost_s`` on."""
    rng = np.random.default_rng(0)
    vision = {"checkpoint": str(checkpoint or "nowhere.safetensors"), "engine": "torch", "threads": 1}
    given = {"object": "paper_cup", "target_n": TARGET_N, "vision": vision, **(REAL if real else {})}
    config = config_from(given, "the test")
    records: list[tuple[int, Record]] = []
    for i in range(600):
        t_s, t_ns = i / 100, START_NS + i * 10 * NS_PER_MS
        true_n = force_n(t_s)
        phase = next(name for start_s, name in reversed(PHASES) if t_s >= start_s)
        outcome = "held" if t_s > 3.4 else ""
        reason = "steady within 0.2 N" if 3.4 < t_s <= 3.41 else ""
        current_n = 0.85 * true_n + 0.3 * (t_s > 0.5) + rng.normal(0, 0.05)
        source = EstimateSource.FUSED if t_s < lost_s else EstimateSource.CURRENT
        fused = FusedForce(t_ns, true_n + rng.normal(0, 0.06), 0.2, current_n, 0.1, 0.9, source)
        reference_n = float(np.interp(t_s, [1.4, 2.2, 5.0, 5.01], [0, TARGET_N, TARGET_N, 0]))
        status = GraspStatus(t_ns, phase, outcome, reference_n, 0.04, reason)
        cell = LoadCellSample(t_ns, true_n + rng.normal(0, 0.03), 0.0, valid=i % 50 != 0)
        servo = ServoState(t_ns, 0.2, 0.0, 0.1 * true_n, 31.0 + 0.5 * t_s, 12.0, 0)
        command = ServoCommand(t_ns, 0.3, 0.12 * true_n)
        records += [(t_ns, record) for record in (fused, status, cell, servo, command)]
        if i % 3 == 0:
            ready_ns = t_ns + round(rng.gamma(9, 2.0) * NS_PER_MS)
            received_ns = t_ns + round(rng.gamma(20, 0.5) * NS_PER_MS)
            records.append((received_ns, Frame(t_ns, received_ns, i // 3, picture(true_n))))
            seen_n, compute_ms = true_n + rng.normal(0, 0.25), rng.gamma(30, 0.15)
            if t_s < lost_s:
                records.append((ready_ns, VisualForce(t_ns, ready_ns, i // 3, seen_n, 0.3, compute_ms)))
    request_ns = START_NS + NS_PER_S // 2
    records.append((request_ns, Request(request_ns, "grasp", TARGET_N)))
    event = Event(START_NS + 3 * NS_PER_S, "camera", "1 frame lost <after> 41 & before 43")
    records.append((event.t_ns, event))
    if lost_s < math.inf:
        lost_ns = START_NS + round(lost_s * NS_PER_S)
        text = "vision dropped out: the lens is covered; using motor current alone"
        records.append((lost_ns, Event(lost_ns, "vision", text)))
    with LogWriter(path, config=dump_config(config), metadata={"checkpoint": digest, "version": "0"}) as log:
        for _, record in sorted(records, key=lambda entry: entry[0]):
            log.write(record)
    return path


RISING_N = [0.1 * i for i in range(40)]


def write_recording(folder: Path, forces_n: list[float]) -> Path:
    """An imported recording of an egg: a frame and a load-cell sample each 20 ms, and nothing else."""
    path = folder / "egg.mcap"
    with LogWriter(path, config=dump_config(config_from({"object": "egg"}, "")), metadata={}) as log:
        for i, force_n in enumerate(forces_n):
            t_ns = i * 20 * NS_PER_MS
            log.write(Frame(t_ns, t_ns, i, picture(force_n)))
            log.write(LoadCellSample(t_ns, force_n, force_n))
    return path


def write_network(path: Path) -> str:
    """A small untrained SSAM network; returns its digest."""
    torch.manual_seed(0)
    shape = NetworkConfig.model_validate(
        {"attention": "ssam", "size": 64, "width": 0.25, "hidden": 4, "head": 4}
    )
    residuals = (Residual(force_n=0, std_n=1),)
    preprocess = Preprocess(size=64)
    header = Header(members=(shape,), preprocess=preprocess, residuals=residuals, data_digest="", metrics={})
    save_checkpoint(path, [ForceNetwork(shape).eval()], header)
    return load_checkpoint(path).digest


def read(path: Path) -> tuple[Run, list[Picture], str]:
    """The run, its pictures, and the note on them."""
    log = LogReader(path)
    sampler = FrameSampler(log)
    run = read_run(log, sampler.add)
    return run, *sampler.pictures(run)


class Page(HTMLParser):
    """Checks that elements close in order, and collects text, classes and sources."""

    VOID = frozenset({"meta", "br"})

    def __init__(self, text: str) -> None:
        super().__init__()
        self.open: list[str] = []
        self.text: list[str] = []
        self.sources: list[str] = []
        self.classes: list[str] = []
        self.feed(text)
        assert self.open == []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        values = dict(attrs)
        self.sources += [values[key] or "" for key in ("src", "href", "xlink:href") if key in values]
        self.classes += (values.get("class") or "").split()
        if tag not in self.VOID:
            self.open.append(tag)

    def handle_endtag(self, tag: str) -> None:
        if tag not in self.VOID:
            assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        if data.strip() and self.open and self.open[-1] not in {"style", "script"}:
            self.text.append(data.strip())


@pytest.fixture(scope="module")
def grasp(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("report")
    digest = write_network(folder / "net.safetensors")
    return write_grasp(folder / "grasp.mcap", checkpoint=folder / "net.safetensors", digest=digest)


@pytest.fixture(scope="module")
def page(grasp: Path) -> str:
    return write_report(grasp).html.read_text(encoding="utf-8")


@pytest.fixture
def _undrawn(monkeypatch: pytest.MonkeyPatch) -> None:
    """An empty figure instead of the drawn one, which takes seconds."""
    monkeypatch.setattr(report_module, "draw", lambda *_: Figure())


@pytest.mark.usefixtures("page")
def test_report_is_written_next_to_its_log(grasp: Path) -> None:
    assert grasp.with_suffix(".html").is_file()
    image = cv2.imread(str(grasp.with_suffix(".png")))
    assert image is not None
    assert image.shape[1] >= 1200


def test_a_report_made_again_is_the_same_and_its_log_is_read_and_drawn_once(
    grasp: Path, page: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    times_ns, drawn = [], []

    def count(chunk: Chunk, **options: bool) -> list[McapRecord]:
        times_ns.append(chunk.message_start_time)
        records: list[McapRecord] = breakup_chunk(chunk, **options)
        return records

    def kept(run: Run, pictures: list[Picture]) -> Figure:
        drawn.append(draw(run, pictures))
        return drawn[-1]

    monkeypatch.setattr(log_reader_module, "breakup_chunk", count)
    monkeypatch.setattr(report_module, "draw", kept)
    assert write_report(grasp).html.read_text(encoding="utf-8") == page
    assert len(times_ns) == len(set(times_ns)) > 50
    assert len(drawn) == 1


def test_page_is_well_formed_and_needs_no_other_file(page: str) -> None:
    parsed = Page(page)
    images = [source for source in parsed.sources if not source.startswith("#")]
    assert len(images) == 6 + 6 + 1, "frames, frames with attention, and the colour bar"
    assert all(source.startswith("data:image/png;base64,") for source in images)
    assert not re.search(r"https?://|@import|url\((?!#)", page)


def test_headline_shows_target_result_and_latency(page: str) -> None:
    text = Page(page).text
    for what, value in [("Target", "4"), ("Error, steady", "+0.04"), ("Overshoot", None)]:
        assert what in text
        if value is not None:
            assert text[text.index(what) + 1] == value
    assert "Paper cup" in text
    assert "held" in text
    assert any(re.fullmatch(r"1\d\.\d / [34]\d\.\d", entry) for entry in text), "latency p50 / p99"


def test_the_page_states_the_use_of_vision(page: str) -> None:
    assert "vision used in 100 % of the hold" in Page(page).text


def test_the_figure_states_why_vision_was_lost(grasp: Path) -> None:
    run = dataclasses.replace(
        read_run(LogReader(grasp)), vision=HoldVision(0.956, [VisionLoss("it is 70 ms old", 0.42)])
    )
    text = "vision used in 96 % of the hold\nvision lost for 0.4 s: at first it is 70 ms old"
    assert draw(run, []).get_supxlabel() == text
    assert draw(dataclasses.replace(run, vision=None), []).get_supxlabel() == ""


def test_a_time_without_vision_is_marked_with_its_reason_and_not_drawn(tmp_path: Path) -> None:
    run, pictures, _ = read(write_grasp(tmp_path / "lost.mcap", lost_s=3.0))
    assert [loss.reason for loss in run.losses] == ["the lens is covered"]
    assert run.losses[0].start_s == pytest.approx(2.5, abs=0.03)
    assert run.losses[0].end_s == pytest.approx(4.5, abs=0.03)
    texts = [text.get_text() for text in draw(run, []).axes[0].texts]
    assert "vision lost for 2.0 s: the lens is covered" in texts
    assert [picture.vision_n is None for picture in pictures][-2:] == [True, True]


def test_gaps_are_not_drawn() -> None:
    t_s = np.array([0.0, 0.01, 0.02, 0.5, 0.51])
    drawn = with_gaps(Series(t_s, t_s))
    assert np.isnan(drawn.value).tolist() == [False, False, False, True, False, False]
    assert 0.02 < drawn.t_s[3] < 0.5
    assert len(with_gaps(Series(t_s[:3], t_s[:3])).t_s) == 3


def test_uncertainty_and_tolerance_are_drawn_as_bands(grasp: Path) -> None:
    axes = draw(read_run(LogReader(grasp)), []).axes[0]
    bands = {band.get_label(): band.get_paths()[0].get_extents() for band in axes.collections}
    assert bands["tolerance"].height == pytest.approx(2 * 0.04 * TARGET_N, rel=0.01)
    assert bands["90 % interval"].y1 > TARGET_N + 0.3


def test_current_width_and_temperature_are_drawn(grasp: Path) -> None:
    run = read_run(LogReader(grasp))
    assert set(run.motor) == {"goal_a", "current_a", "width_mm", "temperature_c"}
    assert np.median(run.motor["width_mm"].value) == pytest.approx(40.0)
    titles = [axes.get_title(loc="left") for axes in draw(run, []).axes]
    assert "Motor, 31 to 34 °C" in titles


@pytest.mark.usefixtures("_undrawn")
def test_a_simulated_run_says_so_and_shows_no_simulated_latency(tmp_path: Path) -> None:
    log = write_grasp(tmp_path / "simulated.mcap", real=False)
    text = Page(write_report(log).html.read_text(encoding="utf-8")).text
    assert "simulated" in text
    assert not [entry for entry in text if "Latency" in entry]
    titles = [axes.get_title(loc="left") for axes in draw(read_run(LogReader(log)), []).axes]
    assert not [title for title in titles if "on arrival" in title]
    assert [title for title in titles if title.startswith("Estimator, per frame")]


@pytest.mark.usefixtures("_undrawn")
def test_each_touch_of_several_has_a_card(tmp_path: Path) -> None:
    path = write_recording(tmp_path, 100 * [0.01] + 50 * [5.0] + 100 * [0.01] + 50 * [3.0] + 100 * [0.01])
    assert [(touch.start_s, touch.peak_n) for touch in read_run(LogReader(path)).touches] == [
        (2.0, 5.0),
        (5.0, 3.0),
    ]
    text = Page(write_report(path).html.read_text(encoding="utf-8")).text
    assert text[text.index("Touch 2, 5.0 to 6.0 s") + 1] == "3.00"


def test_texts_of_log_are_escaped(page: str) -> None:
    assert "1 frame lost &lt;after&gt; 41 &amp; before 43" in page


def test_every_source_has_a_curve_and_values_for_the_pointer(page: str) -> None:
    for source, style in SOURCES.items():
        assert f"stroke: var(--{source})" in page
        assert style.label in Page(page).text
    tree = json.loads(re.search(r"const all = (.*);", page)[1])  # type: ignore[index]
    assert [line["source"] for line in tree["forces"]] == ["load_cell", "fused", "vision", "current"]
    assert [line["source"] for line in tree["errors"]] == ["fused", "vision", "current"]
    for group in tree.values():
        for line in group:
            assert len(line["t"]) == len(line["v"]) > 100
            assert line["t"] == sorted(line["t"])


def test_time_zero_is_the_first_request(grasp: Path) -> None:
    run = read_run(LogReader(grasp))
    assert run.target_n == TARGET_N
    assert run.outcome == "held"
    assert [(span.phase, round(span.start_s, 2)) for span in run.phases] == [
        (phase, round(start_s - 0.5, 2)) for start_s, phase in PHASES[1:]
    ]
    assert run.begin_s == pytest.approx(-0.5)
    assert run.end_s == pytest.approx(5.5, abs=0.06)
    assert run.score is not None
    assert run.score.overshoot_n == pytest.approx(0.4, abs=0.15)


def test_errors_leave_out_what_no_sample_is_near() -> None:
    cell_s = np.array([0.0, 0.01, 9.99, 10.0])
    estimate_s = np.linspace(0, 10, 601)
    forces = {"load_cell": Series(cell_s, np.array([0.0, 0.0, 5.0, 5.0]))}
    forces["visual"] = Series(estimate_s, np.where(estimate_s < 5, 0.0, 5.0))  # exact where there are samples
    errors = reading_module._errors(forces)["visual"]
    assert np.abs(errors.value).max() < 0.05  # 50 ms of the line between two samples
    assert 6 <= len(errors.value) <= 9


def test_errors_use_valid_samples_only(grasp: Path) -> None:
    run = read_run(LogReader(grasp))
    assert len(run.forces["load_cell"].t_s) == 600 - 12
    assert abs(run.errors["fused"].value.mean()) < 0.02
    in_hold = (run.errors["current"].t_s > 3) & (run.errors["current"].t_s < 4)
    assert run.errors["current"].value[in_hold].mean() == pytest.approx(-0.15 * TARGET_N + 0.3, abs=0.05)


def test_event_rows_hold_requests_phases_outcomes_and_events_in_order(grasp: Path) -> None:
    rows = read_run(LogReader(grasp)).event_rows
    assert [row.t_s for row in rows] == sorted(row.t_s for row in rows)
    texts = [(row.unit, row.text) for row in rows]
    assert ("request", "grasp at 4 N") in texts
    assert ("outcome", "held") in texts
    assert ("phase", "ramp") in texts
    assert ("control", "steady within 0.2 N") in texts


def test_pointer_areas_lie_over_the_charts(page: str) -> None:
    areas = re.findall(
        r'class="chart" data-series="(\w+)" data-from="(.*?)" data-to="(.*?)" style="(.*?)"', page
    )
    assert [name for name, *_ in areas] == ["forces", "errors"]
    tops, bottoms = [], []
    for _, begin_s, end_s, style in areas:
        assert float(begin_s) == pytest.approx(-0.5)
        assert float(end_s) == pytest.approx(5.5, abs=0.06)
        box = {key: float(value) for key, value in re.findall(r"(\w+):([\d.]+)%", style)}
        assert 0 < box["left"] < 10
        assert 90 < box["left"] + box["width"] <= 100
        tops.append(box["top"])
        bottoms.append(box["top"] + box["height"])
    assert 0 < tops[0] < bottoms[0] < tops[1] < bottoms[1] < 100


def test_drawing_uses_the_colours_of_the_page(page: str) -> None:
    drawing = page[page.index("<svg") : page.index("</svg>")]
    assert not [colour for colour in CSS_COLOURS if colour in drawing]
    variables = set(re.findall(r"var\((--\w+)\)", drawing))
    dark = page[page.index("prefers-color-scheme:dark") :].split("}}")[0]
    assert variables
    assert all(f"{name}:" in dark for name in variables)


def test_frames_span_the_grip_and_show_attention(grasp: Path) -> None:
    _, pictures, note = read(grasp)
    assert len(pictures) == 6
    assert pictures[0].t_s == pytest.approx(0.3, abs=0.03)
    assert pictures[-1].t_s == pytest.approx(4.8, abs=0.03)
    assert "spatial attention" in note
    assert np.ptp(pictures[3].image, axis=2).max() == 0, "the frame as it was"
    assert pictures[3].overlay is not None
    assert np.ptp(pictures[3].overlay, axis=2).max() > 20, "the attention is in colour"
    assert pictures[3].load_cell_n == pytest.approx(TARGET_N, abs=0.2)


def test_a_frame_that_the_network_did_not_see_has_no_attention(grasp: Path) -> None:
    log = LogReader(grasp)
    sampler = FrameSampler(log)
    frames = list(log.records(Frame))
    for i, frame in enumerate(frames):
        covered = i >= 100
        sampler.add(dataclasses.replace(frame, gray=np.full_like(frame.gray, 90)) if covered else frame)
    attention = [kept.attention is not None for kept in sampler._candidates]
    assert any(attention[:100])
    assert not any(attention[100:])


def test_a_frame_whose_estimate_is_not_finite_has_no_attention(
    grasp: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    log = LogReader(grasp)
    sampler = FrameSampler(log)

    def diverge(_: object, __: object) -> None:
        raise NonFiniteError("the network returned [nan] N")

    monkeypatch.setattr(ForceEstimator, "update", diverge)
    for frame in islice(log.records(Frame), 3):
        sampler.add(frame)
    assert [kept.attention for kept in sampler._candidates] == [None] * 3


@pytest.mark.parametrize("refused", [False, True])
def test_attention_follows_a_new_object_unless_it_was_refused(
    grasp: Path, monkeypatch: pytest.MonkeyPatch, refused: bool
) -> None:
    log = LogReader(grasp)
    sampler, before = FrameSampler(log), []
    frames = list(islice(log.records(Frame), 20))
    monkeypatch.setattr(ForceEstimator, "renew_reference", lambda _: before.append(len(sampler._candidates)))
    for i, frame in enumerate(frames):
        if i == 10:
            now_ns = frames[10].t_ns  # frame 10 was on its way
            sampler.add(Request(now_ns, RequestKind.GRASP, 3.0, new_object=True))
            if refused:
                sampler.add(Event(now_ns, "control", "refused 'grasp': an object is held"))
        sampler.add(frame)
    assert before == ([] if refused else [11])


def test_frames_of_recording_span_its_touch(tmp_path: Path) -> None:
    _, pictures, note = read(write_recording(tmp_path, 100 * [0.01] + 100 * [5.0] + 100 * [0.01]))
    assert [round(p.t_s, 1) for p in pictures] == [1.7, 2.2, 2.7, 3.2, 3.8, 4.3]
    assert note == ""


def test_long_log_keeps_few_frames(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(pictures_module, "_KEPT", 20)
    reader = LogReader(write_recording(tmp_path, 300 * [0.0]))
    sampler = FrameSampler(reader)
    kept = []

    def add(record: Record) -> None:
        sampler.add(record)
        kept.append(len(sampler._candidates))

    shown, _ = sampler.pictures(read_run(reader, add))
    assert max(kept) <= 20
    assert np.diff([one.t_s for one in shown]) == pytest.approx(300 * 0.02 / 5, abs=0.4)


def test_attention_of_another_checkpoint_is_not_shown(tmp_path: Path) -> None:
    missing = write_grasp(tmp_path / "missing.mcap", digest="of the run")
    _, pictures, note = read(missing)
    assert "Attention is not shown" in note
    assert "nowhere.safetensors" in note
    assert all(np.ptp(picture.image, axis=2).max() == 0 for picture in pictures)
    write_network(tmp_path / "other.safetensors")
    other = write_grasp(tmp_path / "o.mcap", checkpoint=tmp_path / "other.safetensors", digest="of another")
    assert "is not the run's checkpoint" in read(other)[2]


def test_report_of_recording_without_a_run(tmp_path: Path) -> None:
    paths = write_report(write_recording(tmp_path, RISING_N))
    parsed = Page(paths.html.read_text(encoding="utf-8"))
    assert "Egg" in parsed.text
    assert "Force" in parsed.text
    for absent in ("Target", "Latency", "Error against the load cell", "Phases and events"):
        assert absent not in parsed.text
    assert not any("ttention" in text for text in parsed.text)
    assert "stroke: var(--load_cell)" in paths.html.read_text(encoding="utf-8")
    assert sum(source.startswith("data:") for source in parsed.sources) == 6


@pytest.mark.usefixtures("_undrawn")
def test_report_of_empty_log(tmp_path: Path) -> None:
    path = tmp_path / "empty.mcap"
    LogWriter(path, config="", metadata={}).close()
    assert "Sponge" in Page(write_report(path).html.read_text(encoding="utf-8")).text


@pytest.mark.usefixtures("_undrawn")
def test_truncated_log_is_reported_with_recover(grasp: Path, tmp_path: Path) -> None:
    cut = tmp_path / "cut.mcap"
    cut.write_bytes(grasp.read_bytes()[: grasp.stat().st_size // 2])
    with pytest.raises(LogError, match="--recover"):
        write_report(cut)
    assert write_report(cut, recover=True).html.is_file()


@pytest.mark.usefixtures("_undrawn")
def test_report_that_cannot_be_written_raises(tmp_path: Path) -> None:
    log = write_recording(tmp_path, RISING_N)
    log.with_suffix(".html").mkdir()
    with pytest.raises(LogError, match="can't write the report"):
        write_report(log)


def test_overlay_colours_only_where_attention_is() -> None:
    attention = np.zeros((8, 8), np.float32)
    attention[1, 6] = 0.9
    image = overlay(np.full((64, 64), 100, np.uint8), attention)
    warmth = image[:, :, 0].astype(int) - image[:, :, 2]
    y, x = np.unravel_index(warmth.argmax(), warmth.shape)
    assert (int(y) // 8, int(x) // 8) == (1, 6)
    assert (image[40:, :20] == 100).all()


def test_histogram_counts_every_value() -> None:
    values = np.array([*np.full(99, 5.0), 500.0])
    counts, edges = histogram(values)
    assert counts.sum() == 100
    assert len(edges) == len(counts) + 1
