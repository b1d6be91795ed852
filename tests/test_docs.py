"""The documentation is true: its code runs, its generated page is current, its picture of the rooms is the code's.

Expected values are what the pages themselves print.
"""

from __future__ import annotations

import ast
import re
import runpy
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

import gyromodel
from gyromodel import cli, declarations
from gyromodel.noise_analysis import analyse_noise

ROOT = Path(__file__).resolve().parents[1]
PACKAGE = Path(gyromodel.__file__).parent
README = (ROOT / "README.md").read_text(encoding="utf-8")
PAGES = sorted([ROOT / "README.md", ROOT / "CHANGELOG.md", *(ROOT / "docs").rglob("*.md")])
BLOCKS = re.findall(r"^```python\n(.*?)^```$", README, re.MULTILINE | re.DOTALL)
ROOMS = {
    name.rstrip("/").removesuffix(".py"): int(floor)
    for floor, name in re.findall(r"^\| (\d) \| `(\w+(?:/|\.py))` \|", README, re.MULTILINE)
}


def simulate_demo(folder: Path) -> None:
    """The fiber-optic campaign that `gyromodel demo` writes."""
    from gyromodel.plan import read_plan
    from gyromodel.simulation import simulate

    truth = gyromodel.read_model(PACKAGE / "data" / "fiber_optic_truth.yaml")
    campaign = simulate(truth, read_plan(PACKAGE / "data" / "fiber_optic_plan.yaml"), seed=0)
    folder.mkdir(parents=True, exist_ok=True)
    gyromodel.write_campaign(campaign, folder / "campaign.csv")


@pytest.mark.long
def test_every_python_block_of_the_readme_runs(tmp_path: Path):
    simulate_demo(tmp_path / "gyromodel-demo" / "fiber_optic")
    (tmp_path / "blocks.py").write_text("\n".join(BLOCKS), encoding="utf-8")
    command = [sys.executable, "-W", "error", "blocks.py"]
    done = subprocess.run(command, capture_output=True, text=True, check=False, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    bias, temperature, found, supply, *values = done.stdout.splitlines()
    assert bias.startswith("bias  ")
    assert temperature.startswith("bias_temperature  ")
    assert found.startswith("named ['bias_temperature_rate'] ")
    assert f"# {supply}\n" in README
    assert f"# {', '.join(values)}\n" in README


@pytest.mark.long
def test_the_first_answer_is_what_the_demo_finds(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    simulate_demo(tmp_path)
    block = next(b for b in re.findall(r"^```yaml\n(.*?)^```$", README, re.MULTILINE | re.DOTALL) if "noise: auto" in b)
    (tmp_path / "simulation.yaml").write_text(block, encoding="utf-8")
    with pytest.raises(SystemExit):
        cli.main(["diagnose", str(tmp_path / "campaign.csv"), "--model", str(tmp_path / "simulation.yaml"),
                  "-o", str(tmp_path / "results")])  # fmt: skip
    said = " ".join(capsys.readouterr().out.split()).partition(str(tmp_path))[0].strip()
    assert said.startswith("Your simulation lacks a temperature-rate bias")
    assert said in " ".join(README.split())


def test_the_ring_laser_table_is_what_the_demo_finds():
    campaign = gyromodel.read_campaign(PACKAGE / "data" / "ring_laser_table.csv")
    found = gyromodel.diagnose(campaign, gyromodel.read_model(PACKAGE / "data" / "ring_laser_model.yaml"))
    assert found.verdict == "ambiguous"
    assert {cause.effect for cause in found.causes} == {"outliers", "scale_spline"}
    for p in found.causes[0].parameters:
        rate = re.findall(r"\d+", p.name)[0]
        shift = f"{p.value:+.3f} ± {p.std:.3f}".replace("-", "−")
        assert f"| {rate} | {shift} |" in README
    assert f"ln B = {found.rounds[1].statistic:.1f};" in README
    error = f"{found.rounds[1].held_out:.3f} deg/s instead of {found.rounds[0].held_out:.1f})"
    assert error in " ".join(README.split())


def test_the_page_of_results_has_every_key(tmp_path: Path):
    """Of a diagnosis that finds something, a fit and an Allan deviation; and no key that there is not."""
    page = (ROOT / "docs" / "results.md").read_text(encoding="utf-8")
    simulate_demo(tmp_path)
    campaign = gyromodel.read_campaign(tmp_path / "campaign.csv")
    found = gyromodel.diagnose(campaign, gyromodel.model_from_effects(["bias", "bias_temperature"]), hold_out=False)
    diagnosed = found.to_dict() | {"model": ""}
    results = {
        "diagnosis.json": {*diagnosed, *(f"causes[].{key}" for key in diagnosed["causes"][0])},
        "fit.json": {*found.extended.to_dict()},
        "allan.json": {*analyse_noise(campaign).to_dict()},
    }
    for name, keys in results.items():
        part = page.split(f"## {name}")[1].split("\n## ")[0]
        told = re.findall(r"^\| (`.+?`) \|", part, re.MULTILINE)
        named = [key for row in told for key in re.findall(r"`([^`]+)`", row)]
        whole = {f"causes[].{key}" if key in ("p_adjusted", "places") else key for key in named}
        assert whole == keys, name


def test_an_effect_in_one_file_enters_the_catalogue(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    before = set(declarations.declarations())
    shutil.copytree(PACKAGE / "effects", tmp_path / "effects")
    block = next(b for b in BLOCKS if "class BiasSupplyDropout" in b)
    (tmp_path / "effects" / "supply.py").write_text(block, encoding="utf-8")
    monkeypatch.setattr(declarations, "FOLDER", tmp_path / "effects")
    found = declarations.declarations()
    assert set(found) - before == {"bias_supply_dropout"}
    assert [p.name for p in found["bias_supply_dropout"].parameters] == ["slope", "dropout"]


def test_the_catalogue_page_is_what_the_code_says():
    page = runpy.run_path(str(ROOT / "docs" / "make_effects_page.py"))["page"]()
    assert (ROOT / "docs" / "effects.md").read_text(encoding="utf-8") == page, "run python docs/make_effects_page.py"


def test_the_readme_names_every_room():
    found = {p.stem for p in PACKAGE.iterdir() if p.suffix == ".py" or (p / "__init__.py").exists()}
    assert set(ROOMS) == {name for name in found if not name.startswith("_")}


@pytest.mark.parametrize("room", ROOMS)
def test_a_room_imports_only_from_lower_floors(room: str):
    place = PACKAGE / room
    for path in sorted(place.rglob("*.py")) if place.is_dir() else [place.with_suffix(".py")]:
        for other in imported_rooms(path) - {room}:
            assert ROOMS[other] < ROOMS[room], f"{path.name} imports {other}"


def imported_rooms(path: Path) -> set[str]:
    """Rooms of the package that a file imports; private modules beside the rooms belong to whoever uses them."""
    modules = []
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("gyromodel."):
            modules.append(node.module or "")
        elif isinstance(node, ast.Import):
            modules += [a.name for a in node.names if a.name.startswith("gyromodel.")]
    rooms = {module.split(".")[1] for module in modules}
    return {name for name in rooms if not name.startswith("_")}


def test_the_readme_lists_the_commands():
    commands = {command.callback.__name__ for command in cli.app.registered_commands if command.callback}
    table = README.partition("| command |")[2].partition("\n\n")[0]
    assert set(re.findall(r"^\| `(\w+)", table, re.MULTILINE)) == commands


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_links_lead_somewhere(page: Path):
    text = page.read_text(encoding="utf-8")
    for target in re.findall(r"\]\(([^)#\s]+)(?:#[^)]*)?\)", text):
        assert (page.parent / target).exists(), target
    headings = {re.sub(r"[^\w\- ]", "", h.lower()).replace(" ", "-") for h in re.findall(r"^#+ (.*)$", text, re.M)}
    assert set(re.findall(r"\]\(#([^)]+)\)", text)) <= headings


def test_images_are_small():
    for image in (ROOT / "docs" / "images").iterdir():
        assert image.stat().st_size < 300_000, image.name
