"""Three-dimensional scene: ground, sensors with their images, and points on the platform."""

import math
from typing import Any, Final

import numpy as np
import viser

from ertis_numba.geometry import round_step
from ertis_numba.viewer._shapes import Dome, Drawn, DrawnFrame, Sector

__all__ = ["Space"]

_RINGS: Final = 7  # distances on the ground at most
_GROUND: Final = 0.001  # by the range that is seen, that the ground lies below the sensors
_NEAR, _FAR = 0.002, 200.0  # by the range that is seen, between which the camera sees anything
_AXES: Final = 0.024  # length of a sensor's axes, by the range that is seen
_POINT: Final = 0.012  # size of a point, by the range that is seen
_SIZES: Final = (0.3, 0.5, 0.75, 1.0)  # of points, as they fade: nothing of what they lie on can be seen through them
_TURN: Final = (0.0, math.sqrt(0.5), -math.sqrt(0.5), 0.0)  # w, x, y, z: up in a picture, which is -y, is ahead
_LABEL: Final = 0.08  # by the range that is seen, that the name of a sensor stands before it
_BELOW: Final = 0.01  # by the range that is seen, that an image lies below its points
_STILL: Final = 1e-3  # of its distance, by which a camera that nobody moves is elsewhere
_NONE: Final = np.zeros((1, 3), np.float32)


class Space:
    """Three-dimensional scene in viser."""

    def __init__(self, server: viser.ViserServer) -> None:
        self._server, self._scene = server, server.scene
        self._nodes: dict[str, _Nodes] = {}
        self._fused: tuple[object, viser.ImageHandle] | None = None
        self._plan: Sector | None = None
        self._farthest_m = 0.0
        self._names: frozenset[str] = frozenset()  # of all sensors that were seen
        self._labels: list[viser.LabelHandle] = []
        self._stood = False  # the camera where all can be seen, rather than where viser puts it

    def show(self, frame: DrawnFrame) -> None:
        """Draw a frame."""
        self._look_at(frame)
        for name, drawn in frame.sensors.items():
            if name not in self._nodes and drawn.pose is not None:
                self._nodes[name] = _Nodes(self._scene, name)
        for name, nodes in self._nodes.items():
            nodes.show(frame.sensors.get(name), frame.range_m)
        self._show_fused(frame)

    def _show_fused(self, frame: DrawnFrame) -> None:
        """Draw the fused image of all sensors, if there is one."""
        if self._fused is not None:
            self._fused[1].visible = frame.fused is not None
        if frame.fused is None or frame.fused is self._plan:
            return
        self._plan = frame.fused
        made_for = (frame.fused.extent_m, frame.height_m)
        if self._fused is not None and self._fused[0] == made_for:
            self._fused[1].image = frame.fused.colours
        else:
            self._fused = made_for, _plan(self._scene, "/fused", frame.fused, frame.height_m)

    def _look_at(self, frame: DrawnFrame) -> None:
        """Draw the ground, and position the camera for a complete view; again after the range grows or sensors join."""
        names = self._names | frame.sensors.keys()
        farthest_m = max(self._farthest_m, frame.range_m)
        if frame.scale is not None and names != self._names:  # Spheres of acoustic maps shrink as sensors join.
            farthest_m = frame.range_m
        if (farthest_m, names) == (self._farthest_m, self._names) or not frame.sensors:
            return
        self._farthest_m, self._names = farthest_m, names
        step_m = round_step(farthest_m, _RINGS)
        half_m = math.ceil(farthest_m / step_m - 1e-9) * step_m
        self._grid = self._scene.add_grid(
            "/grid",
            width=2 * half_m,
            height=2 * half_m,
            cell_size=step_m / 2,
            section_size=step_m,
            cell_color=(38, 42, 52),
            section_color=(70, 76, 92),
            shadow_opacity=0.0,
            position=(0.0, 0.0, -_GROUND * half_m),
            fade_distance=8 * half_m,
        )
        if frame.scale is None:  # The spheres of acoustic maps have no distance.
            self._name_distances(half_m, step_m)
        x, y, z = frame.centre_m
        away_m = farthest_m * (1.2 if len(names) == 1 else 1.25)
        self._stand((x - away_m, y, z + away_m), (x, y, z))

    def _name_distances(self, half_m: float, step_m: float) -> None:
        """Write distances on the ground."""
        for label in self._labels:
            label.remove()
        first = 1 if len(self._names) == 1 else 2  # the names of several stand close to the middle
        self._labels = [
            self._scene.add_label(
                f"/ground/{number}",
                f"{number * step_m:.4g} m",
                position=(number * step_m, 0.0, 0.0),
                font_screen_scale=0.7,
                anchor="center-center",
            )
            for number in range(first, round(half_m / step_m) + 1)
        ]

    def _stand(self, position_m: tuple[float, float, float], look_at_m: tuple[float, float, float]) -> None:
        """Position the camera of future browsers, and of those whose users have not moved it."""
        first = self._server.initial_camera
        before_m = np.concatenate([first.position, first.look_at])
        first.position, first.look_at = position_m, look_at_m
        first.near, first.far = near_m, far_m = _NEAR * self._farthest_m, _FAR * self._farthest_m
        for client in self._server.get_clients().values():
            camera = client.camera
            camera.near, camera.far = near_m, far_m
            there_m = np.concatenate([camera.position, camera.look_at])
            if not self._stood or np.allclose(there_m, before_m, atol=_STILL * np.linalg.norm(before_m)):
                camera.position, camera.look_at = position_m, look_at_m
        self._stood = True


class _Nodes:
    """Scene nodes of a sensor."""

    def __init__(self, scene: viser.SceneApi, name: str) -> None:
        self._scene, self._name = scene, name
        self._frame = scene.add_frame(f"/sensors/{name}")
        self._axes_m = 0.0
        self._label = scene.add_label(f"/sensors/{name}/name", name, font_screen_scale=0.9, anchor="center-center")
        self._points = [
            scene.add_point_cloud(
                f"/points/{name}/{number}",
                _NONE,
                (0, 0, 0),
                point_shape="circle",
                precision="float32",
                point_shading="flat",
                visible=False,
            )
            for number in range(len(_SIZES))
        ]
        self._shape: Any = None
        self._made_for: object = None
        self._shown: object = None

    def show(self, drawn: Drawn | None, farthest_m: float) -> None:
        """Draw the sensor, or remove it if it has no image or no pose."""
        self._frame.visible = drawn is not None and drawn.pose is not None
        if drawn is None or drawn.pose is None:
            for cloud in self._points:
                cloud.visible = False
            return
        x, y, z, w = drawn.pose.rotation_xyzw
        self._frame.wxyz = (w, x, y, z)
        self._frame.position = drawn.pose.translation_m
        if self._axes_m != _AXES * farthest_m:
            self._axes_m = _AXES * farthest_m
            self._frame.axes_length, self._frame.axes_radius = self._axes_m, self._axes_m / 30
            self._frame.origin_radius = self._axes_m / 15
        self._label.position = (_LABEL * farthest_m, 0.0, 0.0)
        self._show_points(drawn, _POINT * farthest_m)
        if self._shape is not None:
            self._shape.visible = drawn.shape is not None
        if drawn.shape is self._shown:  # what changes is sent to browsers and kept in recordings
            return
        self._shown = drawn.shape
        if isinstance(drawn.shape, Sector):
            self._show_sector(drawn.shape, overdue=drawn.overdue)
        elif drawn.shape is not None:
            self._show_dome(drawn.shape)

    def _show_points(self, drawn: Drawn, size_m: float) -> None:
        """Draw points with sizes that follow their remaining share."""
        sizes = np.ceil(drawn.share_left * len(_SIZES)) - 1
        for number, (cloud, share) in enumerate(zip(self._points, _SIZES, strict=True)):
            chosen = sizes == number
            cloud.visible = bool(chosen.any())
            if cloud.visible:
                cloud.points, cloud.colors = drawn.position_m[chosen], drawn.colours[chosen]
                cloud.point_size = share * size_m

    def _show_sector(self, sector: Sector, *, overdue: bool) -> None:
        made_for = (Sector, sector.extent_m, overdue)
        if self._made_for == made_for:
            self._shape.image = sector.colours
            return
        self._made_for = made_for
        under_m = -_BELOW * sector.extent_m[3] if overdue else 0.0  # it hides nothing of what others see
        self._shape = _plan(self._scene, f"/sensors/{self._name}/image", sector, under_m)

    def _show_dome(self, dome: Dome) -> None:
        made_for = (Dome, dome.size_m)
        if self._made_for == made_for:
            self._shape.points, self._shape.colors = dome.position_m, dome.colours
            return
        self._made_for = made_for
        self._shape = self._scene.add_point_cloud(
            f"/sensors/{self._name}/image",
            dome.position_m,
            dome.colours,
            point_size=dome.size_m,
            point_shape="circle",
            precision="float32",
            point_shading="flat",
        )


def _plan(scene: viser.SceneApi, name: str, sector: Sector, height_m: float = 0.0) -> viser.ImageHandle:
    """Return an image in the horizontal plane of its frame, x ahead."""
    west, east, low, high = sector.extent_m
    return scene.add_image(
        name,
        sector.colours,
        render_width=east - west,
        render_height=high - low,
        format="png",
        cast_shadow=False,
        receive_shadow=False,
        wxyz=_TURN,
        position=((low + high) / 2, -(west + east) / 2, height_m - _BELOW * high),
    )
