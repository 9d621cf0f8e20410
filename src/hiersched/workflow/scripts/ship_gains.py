"""Design the gains that the package ships: those of its scenarios."""

from hiersched.scenario import load_scenario
from hiersched.scenario.plugins import CONFIG
from hiersched.simulator.gain_source import SHIPPED, design_schedule, shipped_file


def main() -> None:
    scenarios = map(load_scenario, (CONFIG / "scenarios").glob("*.yaml"))
    files = {shipped_file(scenario): scenario for scenario in scenarios}
    SHIPPED.mkdir(exist_ok=True)
    for old in set(SHIPPED.iterdir()) - files.keys():
        old.unlink()
    for path, scenario in files.items():
        path.write_text(design_schedule(scenario).to_json(), encoding="utf-8")


if __name__ == "__main__":
    main()
