"""The scene in three dimensions: the ground, sensors with their images, and points on the platform."""

import math
from typing import Any, Final

import numpy as np
import viser

from ertis_numba.viewer._shapes import Dome, Drawn, Frame, Sector

__all__ = ["Space"]

_POINT: Final = 0.012  # size of a point, by the range that is seen
_TURN: Final = (0.0, math.sqrt(0.5), -math.sqrt(0.5), 0.0)  # w, x, y, z: up in a picture, which is -y, is ahead
_LABEL: Final = 0.08  # by the range that is seen, that the name of a sensor stands before it
_BELOW: Final = 0.01  # by the range that is seen, that an image lies below its points
_NONE: Final = np.zeros((1, 3), np.float32)


class Space:
    """Hands what is to be drawn in three dimensions to viser.

    Parameters
    ----------
    server : viser.ViserServer
    """

    def __init__(self, server: viser.ViserServer) -> None:
        self._server, self._scene = server, server.scene
        self._nodes: dict[str, _Nodes] = {}
        self._fused: tuple[object, viser.ImageHandle] | None = None
        self._farthest_m = 0.0

    def show(self, frame: Frame) -> None:
        """Draw a frame."""
        self._look_at(frame)
        for name, drawn in frame.sensors.items():
            if name not in self._nodes:
                self._nodes[name] = _Nodes(self._scene, name)
            self._nodes[name].show(drawn, frame.range_m)
        self._show_fused(frame)

    def _show_fused(self, frame: Frame) -> None:
        """Draw one image of all sensors, where there is one."""
        if self._fused is not None:
            self._fused[1].visible = frame.fused is not None
        if frame.fused is None:
            return
        made_for = (frame.fused.extent_m, frame.height_m)
        if self._fused is not None and self._fused[0] == made_for:
            self._fused[1].image = frame.fused.colours
        else:
            self._fused = made_for, _plan(self._scene, "/fused", frame.fused, frame.height_m)

    def _look_at(self, frame: Frame) -> None:
        """Draw the ground, again where more is seen, and set the camera where all of it can be seen."""
        farthest_m = frame.range_m
        if farthest_m <= self._farthest_m or not frame.sensors:
            return
        first = not self._farthest_m
        self._farthest_m = farthest_m
        half_m = max(1, math.ceil(farthest_m))
        self._scene.add_grid(
            "/grid",
            width=2.0 * half_m,
            height=2.0 * half_m,
            cell_size=0.5,
            section_size=1.0,
            cell_color=(38, 42, 52),
            section_color=(70, 76, 92),
            shadow_opacity=0.0,
            position=(0.0, 0.0, -0.005),
            fade_distance=8.0 * half_m,
        )
        if not first:
            return
        step_m = max(1, math.ceil(half_m / 6))
        first_m = step_m if len(frame.sensors) == 1 else 2 * step_m  # the names of several stand close to the middle
        for place_m in range(first_m, half_m + 1, step_m):
            self._scene.add_label(
                f"/ground/{place_m}",
                f"{place_m} m",
                position=(float(place_m), 0.0, 0.0),
                font_screen_scale=0.7,
                anchor="center-center",
            )
        camera = self._server.initial_camera
        x, y, z = frame.centre_m
        away_m = farthest_m * (1.2 if len(frame.sensors) == 1 else 1.25)
        camera.position = (x - away_m, y, z + away_m)
        camera.look_at = (x, y, z)
        for client in self._server.get_clients().values():
            client.camera.position = camera.position
            client.camera.look_at = camera.look_at


class _Nodes:
    """What the scene holds of a sensor."""

    def __init__(self, scene: viser.SceneApi, name: str) -> None:
        self._scene, self._name = scene, name
        self._frame = scene.add_frame(f"/sensors/{name}", axes_length=0.12, axes_radius=0.004)
        self._label = scene.add_label(f"/sensors/{name}/name", name, font_screen_scale=0.9, anchor="center-center")
        self._points = scene.add_point_cloud(
            f"/points/{name}", _NONE, (0, 0, 0), point_shape="circle", precision="float32", point_shading="flat"
        )
        self._shape: Any = None
        self._made_for: object = None

    def show(self, drawn: Drawn, farthest_m: float) -> None:
        """Draw the sensor."""
        x, y, z, w = drawn.pose.rotation_xyzw
        self._frame.wxyz = (w, x, y, z)
        self._frame.position = drawn.pose.translation_m
        self._label.position = (_LABEL * farthest_m, 0.0, 0.0)
        some = len(drawn.position_m) > 0
        self._points.points = drawn.position_m if some else _NONE
        self._points.colors = drawn.colours if some else np.zeros((1, 3), np.uint8)
        self._points.point_size = _POINT * farthest_m
        self._points.visible = some
        if self._shape is not None:
            self._shape.visible = drawn.shape is not None
        if isinstance(drawn.shape, Sector):
            self._show_sector(drawn.shape)
        elif drawn.shape is not None:
            self._show_dome(drawn.shape)

    def _show_sector(self, sector: Sector) -> None:
        made_for = (Sector, sector.extent_m)
        if self._made_for == made_for:
            self._shape.image = sector.colours
            return
        self._made_for = made_for
        self._shape = _plan(self._scene, f"/sensors/{self._name}/image", sector)

    def _show_dome(self, dome: Dome) -> None:
        made_for = (Dome, len(dome.position_m), dome.size_m)
        if self._made_for == made_for:
            self._shape.colors = dome.colours
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
    """Return an image that lies in the level of its frame, x ahead."""
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
