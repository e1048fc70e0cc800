"""The pages say what the committed JSON files say, mark that, and leave out what is not measured."""

import json
import re
from pathlib import Path
from typing import Any

import pytest
from benchmarks.figures import FIGURES, SUITES
from benchmarks.results import RESULTS
from benchmarks.staleness import MARK, read_result

from benchmarks import markdown, tables

ORIGIN = {
    "commit": "0123456789ab", "dirty": False, "command": "python -m benchmarks.x",
    "date": "2026-11-22T10:00:00",
    "machine": {"cpu": "Some CPU", "cores": 2, "threads": 1, "python": "3.12.1", "packages": {}},
    "seed": 0,
}  # fmt: skip
RATE = {"success": 0.5, "n": 4, "interval": [0.15, 0.85], "mean_steps": 100.0, "touched": 0.25, "moved": 0.0}
LEARNED = {"mine_and_train_s": 200, "peak_mb": 870, "entries": 80, "objects": 12, "checkpoint_mb": 3.5}
FAILURES = {"words": 0, "perception": 1, "reach": 0, "grasp": 1, "placing": 0}
# Headline figures, of whose failed episodes films are looked at.
FILMED = (
    "tabletop",
    "compound",
    "combinations",
    "preconditions",
    "anywhere",
    "libero_goal",
    "libero_spatial",
    "libero_object",
    "libero_10",
    "libero_all",
    "libero_goal_swap",
    "libero_goal_lan",
    "libero_goal_task",
    "libero_goal_object",
)
A_NUMBER = re.compile(r"\d[\d.,]* ?(%|ms\b|s\b|min\b|mm\b|minutes?\b|hours?\b|seconds?\b)")


@pytest.fixture
def results(monkeypatch: pytest.MonkeyPatch) -> dict[str, Any]:
    """Results by name, instead of those in the folder."""
    found: dict[str, Any] = {}
    for module in (markdown, tables):
        monkeypatch.setattr(module, "read_result", found.get)
    return found


def put(results: dict[str, Any], name: str, **content: Any) -> None:
    results[name] = json.loads(json.dumps({**ORIGIN, **content}))


def put_main_result(results: dict[str, Any], **content: Any) -> None:
    rest = {"demonstrations": 10, "failures": FAILURES}
    put(results, "libero_goal", **RATE, **rest, **LEARNED, **content)


def test_the_committed_pages_are_made_of_the_committed_results():
    assert tables.PAGE.read_text() == tables.results_page(), "run: python -m benchmarks.tables"
    readme = tables.README.read_text()
    assert readme == tables.with_headlines(readme), "run: python -m benchmarks.tables"


def test_readme_quotes_no_figure_outside_its_table():
    before, _, rest = tables.README.read_text().partition(tables.BEGIN)
    after = rest.partition(tables.END)[2]
    found = [line for line in (before + after).splitlines() if A_NUMBER.search(line)]
    assert found == []


def test_without_results_there_is_nothing_but_how_to_measure(results):
    text = tables.results_page()
    assert text.count("\n# ") == 1
    assert all(f"- {name}: `{figure.command}`" in text for name, figure in FIGURES.items())
    assert MARK.findall(text) == []
    page = tables.with_headlines(f"a\n{tables.BEGIN}\nold\n{tables.END}\nz\n")
    assert page.startswith("a\n")
    assert page.endswith("\nz\n")
    assert "Nothing is measured" in page


def test_readme_without_a_place_for_figures_is_refused():
    with pytest.raises(ValueError, match="no place for its figures"):
        tables.with_headlines("words")


def test_a_section_is_marked_with_what_it_quotes_and_where_that_comes_from(results):
    put(results, "tracking", n=4, conditions={"displaced": RATE})
    text = tables.results_page()
    assert "| displaced | 50.0 % | 15.0 to 85.0 % | 4 |" in text
    assert MARK.findall(text) == [("tracking", "conditions")]
    assert "`python -m benchmarks.x` on 2026-11-22, commit `0123456789ab`; 2 cores of Some CPU." in text
    assert "- tracking:" not in text


def test_readme_has_a_row_for_what_was_measured_alone(results):
    put(results, "tabletop", **RATE, demonstrations=7, train_s=30.4)
    put(results, "libero_few_shot_3", **RATE, demonstrations=3, mine_and_train_s=None)
    put(results, "libero_goal_swap", **RATE, demonstrations=10)
    put(results, "libero_10", **RATE, demonstrations=10, mine_and_train_s=250.0)
    page = tables.with_headlines(f"{tables.BEGIN}\n{tables.END}")
    rows = [line for line in page.splitlines() if "50.0 %" in line]
    assert [row.split(" <!--")[0] for row in rows] == [
        "| Tabletop | 7 | 50.0 % | 15.0 to 85.0 % | 4 | 30",
        "| LIBERO-GOAL | 3 | 50.0 % | 15.0 to 85.0 % | 4 | -",
        "| LIBERO-10 | 10 | 50.0 % | 15.0 to 85.0 % | 4 | 250",
        "| LIBERO-PRO, objects exchanged | 10 | 50.0 % | 15.0 to 85.0 % | 4 | -",
    ]
    assert ("tabletop", "success") in MARK.findall(rows[0])


def test_readme_stays_on_its_hundred_lines_with_all_figures(results):
    spent = {"train_s": 30.0, "mine_and_train_s": 250.0}
    suites = [f"libero_goal_{kind}" for kind in ("swap", "lan", "task", "object")]
    for name in ("tabletop", "libero_few_shot_3", "libero_few_shot_1", *SUITES, *suites):
        put(results, name, **RATE, demonstrations=10, **spent)
    put(results, "teach", n=4, demonstrations={"1": RATE}, teach_s=9.0)
    page = tables.with_headlines(tables.README.read_text())
    assert page.count("| 50.0 % |") == 12
    assert len(page.splitlines()) <= 100


def test_kinds_of_objects_are_compared_line_by_line(results):
    bowl = {"learned": "patches", "touched": 3, "grasped": 3}
    for kinds, found in (("all", RATE), ("shape", {"success": None, "n": 0, "interval": [0.0, 1.0]})):
        put(
            results,
            "places_libero_goal" + "_shape" * (kinds == "shape"),
            n=4, kinds=kinds, exchanged=False, demonstrations=10, sure=RATE,
            first_look_cpu_ms={"median": 310.0},
            learned={"objects": {"bowl": bowl, "milk": {**bowl, "learned": None}}},
            all={"found": found, "within_10_mm": RATE, "position_mm_median": 4.2},
        )  # fmt: skip
    page = tables.results_page()
    told = "1 of 2 | 50.0 % | 50.0 % | 15.0 to 85.0 % | 4.2 | 50.0 % of 4 | 15.0 to 85.0 % | 310.0 |"
    assert f"| all, as in LIBERO, 10 a task | {told}" in page
    assert "| shape, as in LIBERO, 10 a task | 1 of 2 | - | 50.0 %" in page


def test_failures_are_told_apart_by_rule(results):
    failed = [
        {"task": task, "state": state, "reason": "gave up at lift", "attempts": 2, "off_mm": off}
        for task, state, off in (
            ("push_the_plate", 1, 1.0),
            ("put_the_bowl", 2, 2.0),
            ("put_the_bowl", 3, 30.0),
            ("push_the_plate", 4, None),
        )
    ]
    put_main_result(results, per_task={"put_the_bowl": RATE}, failed=failed)
    text = tables.results_page()
    for category, n in (("perception", 2), ("small tolerances", 1), ("geometric constraints", 1)):
        assert f"| {category} | {n} |" in text
    assert "2 of 4 failed episodes failed in acting" in text
    assert "put the bowl, state 3: gave up at lift" in text


def test_contacts_that_no_task_asks_for_are_told_beside_success(results):
    put(
        results,
        "libero_goal_object",
        **RATE,
        per_task={"put_the_bowl": {**RATE, "moved": None}},
        failures=FAILURES,
    )
    text = tables.results_page()
    assert "| all ten tasks | 50.0 % | 15.0 to 85.0 % | 4 | 100.0 | 25.0 % | 0.0 % |" in text
    assert "| put the bowl | 50.0 % | 15.0 to 85.0 % | 4 | 100.0 | 25.0 % | - |" in text
    assert "| Failed by | words | perception | reach | grasp | placing |" in text
    assert "| episodes | 0 | 1 | 0 | 1 | 0 |" in text


def test_other_suites_have_a_chapter_of_their_own(results):
    learned = {**LEARNED, "demonstrations": 10, "mine_and_train_s": None, "peak_mb": None}
    put(results, "libero_object", **RATE, **learned, per_task={"milk": RATE}, failures=FAILURES)
    text = tables.results_page().partition("# On LIBERO's other suites")[2]
    assert "## On libero_object" in text
    assert "| milk | 50.0 % | 15.0 to 85.0 % | 4 | 100.0 | 25.0 % | 0.0 % |" in text
    assert "on 10 demonstrations a task was interrupted. The checkpoint holds 80 entries" in text
    assert "| episodes | 0 | 1 | 0 | 1 | 0 |" in text
    assert "- libero_10: `python -m benchmarks.libero.run --suite=libero_10 --demos=10" in text


def test_one_policy_for_all_is_told_suite_by_suite_beside_the_policy_of_each_and_what_it_took(results):
    put(
        results,
        "libero_object",
        **{**RATE, "success": 0.6},
        **LEARNED,
        demonstrations=10,
        per_task={},
        failures=FAILURES,
    )
    assert "One policy for all four" not in tables.results_page()
    per_suite = {suite: {**RATE, "failures": FAILURES} for suite in ("libero_object", "libero_10")}
    put(results, "libero_all", **LEARNED, n=8, demonstrations=10, per_suite=per_suite)
    text = tables.results_page().partition("## One policy for all four")[2]
    assert "| libero object | 50.0 % | 15.0 to 85.0 % | 4 | 100.0 | 60.0 % | -10.0 |" in text
    assert "| libero 10 | 50.0 % | 15.0 to 85.0 % | 4 | 100.0 | - | - |" in text
    assert "| libero 10 | 0 | 1 | 0 | 1 | 0 |" in text
    took = "took 200 s (3 min), the largest process 870 MB of memory. The checkpoint holds 80 entries and 12"
    assert f"{took} objects, and has 3.5 MB." in text
    marks = {("libero_all", "peak_mb"), ("libero_all", "checkpoint_mb"), ("libero_object", "success")}
    assert marks <= set(MARK.findall(text))


def test_each_suite_has_a_row_of_few_demonstrations_and_of_the_comparison_with_lerobot_eval(results):
    for suite in SUITES:
        put(results, f"{suite}_equality", suite=suite, n=10, equal=9, actions=1234, largest_difference=0.5)
    put(results, "libero_10_few_shot_3", **RATE, suite="libero_10", demonstrations=3, mine_and_train_s=90)
    text = tables.results_page()
    assert "| libero 10 | 50.0 % | 15.0 to 85.0 % | 4 | 100.0 | 90 |" in text
    equal = text.partition("# The harness against lerobot-eval")[2]
    for suite in SUITES:
        assert f"| {suite.replace('_', ' ')} | 10 | 9 | 1234 | 0.5 |" in equal


def test_what_films_show_is_told_of_the_commit_whose_episodes_they_are_of(results, tmp_path, monkeypatch):
    name = "libero_goal_swap"
    put(results, name, **RATE, per_task={"put_the_bowl": {**RATE, "moved": 0.0}}, failures=FAILURES)
    result = results[name]
    seen = {
        "task": "put_the_bowl",
        "states": [3, 7],
        "kind": "collision",
        "seen": "the hand stands on the rack",
    }
    monkeypatch.setattr(markdown, "LOOKED_AT", tmp_path / "looked_at.json")
    for commit, is_told in ((result["commit"], True), ("another", False)):
        looked = {result["command"]: {"commit": commit, "failed": [seen]}}
        markdown.LOOKED_AT.write_text(json.dumps(looked))
        row = "| put the bowl | 3, 7 | collision | the hand stands on the rack |"
        assert (row in tables.results_page()) == is_told
        assert ("film of each: collision 2." in tables.results_page()) == is_told
    by_seed = {"task": "put_the_bowl", "seeds": [1003], "kind": "grasp", "seen": "it slips"}
    of_earlier = {"commit": result["commit"], "filmed": "ba9876543210", "failed": [by_seed]}
    markdown.LOOKED_AT.write_text(json.dumps({result["command"]: of_earlier}))
    text = tables.results_page()
    assert "| Task | Seeds | Failed by | What is seen |" in text
    assert "| put the bowl | 1003 | grasp |" in text
    assert "film of each in the run of commit `ba9876543210`" in text


def test_what_films_show_is_kept_of_every_failed_episode_of_a_committed_result_once():
    looked_at = json.loads(markdown.LOOKED_AT.read_text())
    committed = [
        json.loads(path.read_text()) for name in FILMED if (path := RESULTS / f"{name}.json").exists()
    ]
    commits = {result["command"]: result["commit"] for result in committed}
    failing = {result["command"]: failed for result in committed if (failed := failed_episodes(result))}
    assert looked_at.keys() == failing.keys()
    for command, looked in looked_at.items():
        assert looked["commit"] == commits[command]
        seen = [(one["task"], n) for one in looked["failed"] for n in one.get("states") or one["seeds"]]
        assert sorted(seen) == sorted(failing[command])


def failed_episodes(result: dict[str, Any]) -> list[tuple[str, int]]:
    """Task and initial state, or seed on the tabletop, of a result's failed episodes."""
    runs = result.get("runs")
    failed = [one for run in runs.values() for one in run["failed"]] if runs else result.get("failed", [])
    return [(one["task"], one["state"]) if isinstance(one, dict) else (one[0], one[1]) for one in failed]


@pytest.mark.parametrize(
    ("name", "title"),
    [
        ("combinations", "New combinations of a thing and a place"),
        ("preconditions", "A drawer that nobody says is shut"),
    ],
)
def test_new_combinations_have_a_row_each_and_all_together(name, title, results):
    run = {**RATE, "per_task": {"a": 0.5}}
    put(results, name, n=4, runs={name: run}, instructions={"a": "put a on b"})
    text = tables.results_page()
    assert title in text
    assert f"| {name} | 50.0 % | 15.0 to 85.0 % | 4 | 100.0 |" in text
    assert "| put a on b | 50.0 % | 15.0 to 85.0 % | 4 |" in text
    assert tables.NOTES[name] in text


def test_first_looks_anywhere_are_told_beside_success_and_so_is_which_layouts_are_left_out(results):
    poses = {
        "poses": 70,
        "unknown": 2,
        "position_mm_mean": 2.5,
        "position_mm_p95": 6.0,
        "yaw_deg_mean": 1.5,
        "turned_round": 3,
    }
    looks = {
        "looks": 7,
        "layouts": {"drawn": 10, "hidden": 1, "unsolved": 2},
        "poses": poses,
        "poses_needed": {**poses, "poses": 20},
        "false_finds": RATE,
        "confident_and_right": RATE,
    }
    run = {**RATE, "per_task": {"a": 0.5}}
    put(results, "anywhere", n=4, runs={"anywhere": run}, instructions={"a": "do a"}, first_looks=looks)
    text = tables.results_page()
    assert "| do a | 50.0 % | 15.0 to 85.0 % | 4 |" in text
    assert "| all that are known | 70 | 2 | 2.5 | 6.0 | 1.5 | 3 |" in text
    assert "| those that the task needs | 20 |" in text
    assert "it was reported in 50.0 % of 4 looks" in text
    assert "3 (30.0 %) not used: 1 do not show" in text
    assert ("anywhere", "first_looks") in MARK.findall(text)


def test_every_thing_that_was_touched_has_a_row_whether_it_was_learned_or_not(results):
    told = {
        "found": RATE,
        "within_10_mm": RATE,
        "absent": {"n": 3, "reported": 1},
        "several": {"n": 2, "all_within_10_mm": 1},
    }
    errors = {"position_mm_median": 2.0, "position_mm_p95": 5.0, "yaw_deg_median": None}
    objects = {"milk": {"grasped": 30, "learned": "shape"}, "basket": {"grasped": 0, "learned": None}}
    put(
        results,
        "places_libero_object",
        learned={"episodes": 30, "seconds": 200.2, "learn_objects_s": 80.4, "objects": objects},
        found={name: {**told, **errors} for name in objects},
        sure=RATE,
        first_look_cpu_ms={"median": 140.0, "p95": 180.0},
    )
    text = tables.results_page()
    assert (
        "| milk | shape | 30 | 50.0 % | 50.0 % | 15.0 to 85.0 % | 4 | 2.0 | 5.0 | - | 1 of 2 | 1 of 3 |"
        in text
    )
    assert "| basket | not learned | 0 |" in text
    assert "took 80 s of the 200 s of mining" in text
    assert "this figure proves little" in text


def test_the_curve_of_few_demonstrations_ends_with_the_main_result(results):
    for n in (3, 1):
        put(results, f"libero_few_shot_{n}", **RATE, demonstrations=n, mine_and_train_s=9)
    put_main_result(results, per_task={}, failed=[])
    rows = [line for line in tables.results_page().splitlines() if line.endswith(("| 9 |", "| 200 |"))]
    assert [row.split("|")[1].strip() for row in rows] == ["1", "3", "10"]


def test_results_that_are_not_current_can_be_dropped(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    folder = tmp_path / "benchmarks/results"
    folder.mkdir(parents=True)
    for name in ("tracking", "nobody_knows"):
        (folder / f"{name}.json").write_text(json.dumps(ORIGIN))
    monkeypatch.setattr(tables, "ROOT", tmp_path)
    current = {"tracking": None, "nobody_knows": "names no command"}
    monkeypatch.setattr(
        tables, "origin", lambda name, paths, **_: type("Origin", (), {"problem": current[name]})
    )  # fmt: skip
    assert [path.stem for path in tables.drop_what_is_not_current()] == ["nobody_knows"]
    assert [path.stem for path in folder.iterdir()] == ["tracking"]


def test_a_result_that_is_there_is_read():
    assert read_result("no_such_figure") is None


def test_what_had_no_episode_is_a_dash():
    none = {"success": None, "interval": None, "n": 0, "mean_steps": None}
    told = markdown.grid({"moved late": none}, markdown.STEPS)
    assert told.splitlines()[-1] == "| moved late | - | - | 0 | - |"


def test_the_time_of_the_whole_is_told_where_nothing_was_kept(results):
    put(results, "tabletop", **RATE, train_s=100.0, total_s=200.0, per_task={"push_plate": 0.5})
    assert "with recording and evaluating 200 s" in tables.results_page()
    assert "| push plate | 50.0 % | 15.0 to 85.0 % | 4 |" in tables.results_page()
    results["tabletop"]["total_s"] = None
    assert "with recording" not in tables.results_page()
