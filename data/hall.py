"""Write the scene of the hall, ``synthetic/scenes/hall.toml``, as a part of ``make data``."""

from pathlib import Path

from ertis_bench.platform_trials.furnished_rooms import hall

PATH = Path(__file__).parent / "synthetic" / "scenes" / "hall.toml"
HEAD = """\
# A robot with four sensors drives three times round a hall of 16 m by 10 m, at 1 m/s and with 14 pulses per second.
# World frame: x along the hall, y across, z up from the floor; the origin is the middle of the hall. The walls are
# rows of small reflectors of random strength, as of rough brick. Written by data/hall.py.
"""
_SEED = 1


def text() -> str:
    """Return the scene as TOML, with one line for each sensor, reflector and waypoint."""
    scene = hall(_SEED)
    waypoints = scene.platform.waypoints if scene.platform else ()
    lines = [HEAD, f"seed = {scene.seed}", f"rate_hz = {scene.rate_hz}", f"count = {scene.count}", "points = ["]
    for point in scene.points:
        x, y, z = point.position_m or (0.0, 0.0, 0.0)
        lines.append(f"  {{position_m = [{x:g}, {y:g}, {z:g}], strength_db = {point.strength_db}}},")
    lines += [
        "]",
        "",
        "# Each waypoint has a time (s), x, y, z (m) and a yaw (degrees).",
        "[platform]",
        "waypoints = [",
    ]
    lines += [f"  [{', '.join(f'{number:g}' for number in waypoint)}]," for waypoint in waypoints]
    lines += ["]"]
    for sensor in scene.sensors:
        x, y, z = sensor.position_m or (0.0, 0.0, 0.0)
        processing, emitter = sensor.processing, sensor.emitter
        lines += [
            "",
            "[[sensors]]",
            f'name = "{sensor.name}"',
            f"position_m = [{x:g}, {y:g}, {z:g}]  # in the frame of the platform",
            f"yaw_deg = {sensor.yaw_deg}",
            f'processing = {{range_m = {list(processing.range_m)}, directions = "{processing.directions}"}}',
            f"emitter = {{level_db = {emitter.level_db}, diameter_m = {emitter.diameter_m}}}",
            f"electronics = {{noise_dbfs = {sensor.electronics.noise_dbfs}}}",
        ]
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    PATH.write_text(text())
