# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Render off screen with VTK, on a GPU or with Mesa's software renderer."""

import colorsys
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from cliploc_ros.core.geometry.camera import Camera
from cliploc_ros.errors import ModelError
from demo.world.appearance import COLORS
from demo.world.meshes import Mesh, make_object
from demo.world.room import HEIGHT_M, LENGTH_M, WIDTH_M, Room
from demo.world.textures import paint, paint_wall, paint_wood

_SUPERSAMPLING = 2


@dataclass(frozen=True)
class Light:
    """The light in a room: brightness of lamp and surroundings, position of the lamp [m]."""

    lamp: float = 0.7
    ambient: float = 0.4
    position: tuple[float, float] = (LENGTH_M / 2, WIDTH_M / 2)
    warmth: float = 0.0

    @staticmethod
    def draw(rng: np.random.Generator) -> 'Light':
        """Draw a light at random."""
        position = (LENGTH_M * rng.uniform(0.3, 0.7), WIDTH_M * rng.uniform(0.3, 0.7))
        return Light(rng.uniform(0.4, 0.8), rng.uniform(0.3, 0.5), position,
                     rng.uniform(-0.06, 0.12))


#: The light while a room is mapped, and after some of its objects moved.
FIRST_LIGHT = Light()
LATER_LIGHT = Light(lamp=0.5, ambient=0.5, position=(4.2, 1.8), warmth=0.08)


class Renderer:
    """Renders the image of a room, and the index of the object at each pixel.

    Parameters
    ----------
    room : Room
        The room.
    camera : Camera
        Pinhole, without distortion.
    light : Light
        Light of the room.

    Raises
    ------
    ModelError
        If VTK is not installed.
    """

    def __init__(self, room: Room, camera: Camera, light: Light) -> None:
        try:
            import vtk
        except ImportError as error:
            raise ModelError('rendering worlds needs VTK: pip install vtk') from error
        self._vtk: Any = vtk
        vtk.vtkLogger.SetStderrVerbosity(vtk.vtkLogger.VERBOSITY_ERROR)
        self._camera = camera
        # Smooth edges by rendering larger images: with multisampling and mipmaps together, Mesa's
        # software renderer takes minutes for some views (measured with Mesa 22.3).
        self._image = self._window(_SUPERSAMPLING)
        self._index = self._window()
        self._light(light)
        self._fill(room)

    def render(self, map_from_camera: npt.NDArray[np.float64]) -> npt.NDArray[np.uint8]:
        """Render the image, (height, width, 3) RGB."""
        large = self._read(self._image, map_from_camera)
        size = self._camera.width, self._camera.height
        return np.asarray(cv2.resize(large, size, interpolation=cv2.INTER_AREA), dtype=np.uint8)

    def render_index(self, map_from_camera: npt.NDArray[np.float64]) -> npt.NDArray[np.int64]:
        """Render the index of the object at each pixel, -1 for none."""
        rgb = self._read(self._index, map_from_camera).astype(np.int64)
        return (rgb[..., 0] * 65536 + rgb[..., 1] * 256 + rgb[..., 2]) - 1

    def _window(self, scale: int = 1) -> Any:
        window, renderer = self._vtk.vtkRenderWindow(), self._vtk.vtkRenderer()
        window.SetOffScreenRendering(1)
        window.SetMultiSamples(0)
        window.SetSize(scale * self._camera.width, scale * self._camera.height)
        window.AddRenderer(renderer)
        renderer.SetBackground(0.0, 0.0, 0.0)
        renderer.AutomaticLightCreationOff()
        return window

    def _light(self, light: Light) -> None:
        """Add a lamp with shadows under the ceiling, and a fill light that brightens shadows."""
        vtk, renderer = self._vtk, self._image.GetRenderers().GetFirstRenderer()
        color = 1.0, 1.0 - light.warmth / 2, 1.0 - light.warmth
        lamp = vtk.vtkLight()
        lamp.SetPosition(*light.position, HEIGHT_M - 0.15)
        lamp.SetFocalPoint(*light.position, 0.0)
        lamp.SetPositional(True)
        lamp.SetConeAngle(82.0)
        lamp.SetExponent(0.0)
        lamp.SetIntensity(light.lamp)
        lamp.SetColor(*color)
        renderer.AddLight(lamp)
        fill = vtk.vtkLight()  # light from walls and ceiling, without shadows
        fill.SetLightTypeToHeadlight()
        fill.SetIntensity(light.ambient)
        fill.SetColor(*color)
        renderer.AddLight(fill)
        shadows, passes = vtk.vtkShadowMapPass(), vtk.vtkRenderPassCollection()
        shadows.GetShadowMapBakerPass().SetResolution(1024)
        passes.AddItem(shadows.GetShadowMapBakerPass())
        passes.AddItem(shadows)
        sequence, camera_pass = vtk.vtkSequencePass(), vtk.vtkCameraPass()
        sequence.SetPasses(passes)
        camera_pass.SetDelegatePass(sequence)
        renderer.SetPass(camera_pass)

    def _fill(self, room: Room) -> None:
        rng = np.random.default_rng(room.seed + 1)
        surfaces = _paint_surfaces(rng)
        for mesh, surface in room.furniture:
            self._add(mesh, np.eye(4), -1, texture=surfaces[surface])
        for index, item in enumerate(room.objects):
            flat = item.look.class_id in ('book', 'box')
            texture = paint(item.look, 1 if flat else 3, rng)
            for mesh, color in make_object(item.look):
                self._add(mesh, item.map_from_object, index,
                          **({'color': COLORS[color]} if color else {'texture': texture}))

    def _add(self, mesh: Mesh, map_from_mesh: npt.NDArray[np.float64], index: int, *,
             color: tuple[int, int, int] = (255, 255, 255),
             texture: npt.NDArray[np.uint8] | None = None) -> None:
        vtk, data = self._vtk, self._poly_data(mesh)
        for window, painted in ((self._image, True), (self._index, False)):
            mapper, actor, matrix = vtk.vtkPolyDataMapper(), vtk.vtkActor(), vtk.vtkMatrix4x4()
            mapper.SetInputData(data)
            actor.SetMapper(mapper)
            matrix.DeepCopy(map_from_mesh.ravel())
            actor.SetUserMatrix(matrix)
            style = actor.GetProperty()
            if painted:
                style.SetColor(*(channel / 255 for channel in color))
                style.SetAmbient(0.32)
                style.SetDiffuse(0.8)
                style.SetSpecular(0.12 if index >= 0 else 0.0)
                style.SetSpecularPower(30)
                if texture is not None:
                    actor.SetTexture(self._texture(texture))
            else:
                code = index + 1
                style.LightingOff()
                style.SetColor(*(channel / 255 for channel in
                                 (code // 65536, code // 256 % 256, code % 256)))
            window.GetRenderers().GetFirstRenderer().AddActor(actor)

    def _poly_data(self, mesh: Mesh) -> Any:
        from vtkmodules.util.numpy_support import numpy_to_vtk, numpy_to_vtkIdTypeArray

        vtk = self._vtk
        points, cells, data = vtk.vtkPoints(), vtk.vtkCellArray(), vtk.vtkPolyData()
        points.SetData(numpy_to_vtk(mesh.vertices, deep=True))
        faces = np.c_[np.full(len(mesh.triangles), 3), mesh.triangles].ravel()
        cells.ImportLegacyFormat(numpy_to_vtkIdTypeArray(faces, deep=True))
        data.SetPoints(points)
        data.SetPolys(cells)
        uv = numpy_to_vtk(mesh.uv, deep=True)
        uv.SetName('uv')
        data.GetPointData().SetTCoords(uv)
        normals = vtk.vtkPolyDataNormals()
        normals.SetInputData(data)
        normals.SetFeatureAngle(40)
        normals.Update()
        return normals.GetOutput()

    def _texture(self, image: npt.NDArray[np.uint8]) -> Any:
        from vtkmodules.util.numpy_support import numpy_to_vtk

        vtk, data = self._vtk, self._vtk.vtkImageData()
        height, width = image.shape[:2]
        data.SetDimensions(width, height, 1)
        scalars = numpy_to_vtk(np.ascontiguousarray(image[::-1]).reshape(-1, 3), deep=True)
        data.GetPointData().SetScalars(scalars)
        texture = vtk.vtkTexture()
        texture.SetInputData(data)
        texture.InterpolateOn()
        texture.MipmapOn()
        texture.RepeatOn()
        return texture

    def _read(self, window: Any, map_from_camera: npt.NDArray[np.float64]) -> \
            npt.NDArray[np.uint8]:
        from vtkmodules.util.numpy_support import vtk_to_numpy

        vtk = self._vtk
        view = window.GetRenderers().GetFirstRenderer().GetActiveCamera()
        eye = map_from_camera[:3, 3]
        view.SetPosition(*eye)
        view.SetFocalPoint(*(eye + map_from_camera[:3, 2]))
        view.SetViewUp(*-map_from_camera[:3, 1])
        view.SetViewAngle(np.degrees(2 * np.arctan(self._camera.height / 2 / self._camera.fy)))
        view.SetClippingRange(0.05, 12.0)
        window.Render()
        grab = vtk.vtkWindowToImageFilter()
        grab.SetInput(window)
        grab.ReadFrontBufferOff()
        grab.ShouldRerenderOff()
        grab.Update()
        scalars = vtk_to_numpy(grab.GetOutput().GetPointData().GetScalars())
        width, height = window.GetSize()
        image = scalars.reshape(height, width, 3)
        return np.ascontiguousarray(image[::-1])


def _paint_surfaces(rng: np.random.Generator) -> dict[str, npt.NDArray[np.uint8]]:
    """Paint the surfaces of the room."""
    def pale(low: float = 0.75) -> tuple[int, int, int]:
        rgb = colorsys.hsv_to_rgb(rng.random(), rng.uniform(0.02, 0.14), rng.uniform(low, 0.92))
        return int(rgb[0] * 255), int(rgb[1] * 255), int(rgb[2] * 255)

    def wood(low: float, high: float) -> tuple[int, int, int]:
        value = rng.uniform(low, high)
        return int(225 * value), int(180 * value), int(130 * value)

    picture = rng.integers(60, 220, (4, 5, 3)).astype(np.uint8)
    return {'floor': paint_wood(wood(0.5, 0.8), rng, planks=8), 'ceiling': paint_wall(pale(), rng),
            'wall': paint_wall(pale(), rng), 'rug': paint_wall(pale(0.4), rng),
            'picture': np.kron(picture, np.ones((48, 48, 1), dtype=np.uint8)),
            'shelf': paint_wood(wood(0.55, 1.0), rng), 'table': paint_wood(wood(0.4, 1.0), rng)}
