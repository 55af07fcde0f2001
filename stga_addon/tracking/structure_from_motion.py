"""Structure from motion (pycolmap): poses and the common lens of images of a still head, without a
calibration.

Runs in a helping process: COLMAP has threads, and cannot be interrupted.
"""

import itertools
import shutil
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ..worker.helpers import Step
from .face_networks import FaceNetworks, PersonNetwork
from .footage.model import FootageCamera, write_png

SEED = 1
"""Seed of all of COLMAP's random choices."""
MAX_IMAGE_PX = 2000
"""Longer side beyond which images are reduced before features are looked for, which bounds time and
memory."""
DOUBLED_IMAGE_PX = 1000
"""Longer side up to which features are looked for in images of twice the size."""
PEAK_THRESHOLD = 0.002
"""Least contrast of a feature, a third of COLMAP's: skin has little. Of 16 photos of a person, 4
times as many points and an error of the focal length of 2 instead of 12 %."""
EDGE_THRESHOLD = 20.0
"""Largest ratio of a feature's curvatures, twice COLMAP's: lashes, lips and seams are edges."""
MAX_FEATURES = 4096
"""Largest number of features of an image, the largest ones: comparing two images takes a time that
is quadratic in it."""
NEAR_IMAGES = 6
"""Images of a video that are compared with one before them. Of 40 around a head, images that are
farther apart share no features: cameras are the same without."""
LOOP_STEP = 4
"""Every LOOP_STEP-th image is compared with all others of them: a camera may come back."""
MODEL_GROWTH = 1.3
"""Ratio by which images or points of a model grow before all of it is adjusted again. COLMAP's 1.1
takes up to twice the time; cameras of three takes are as exact."""
MAX_ADJUSTMENTS = 2
"""Adjustments of a whole model in a row, between which outliers are removed; COLMAP's are 5."""
MAX_ADJUSTMENT_ITERATIONS = 20
"""Iterations of such an adjustment; COLMAP's are 50. The last one is another's: `_adjust`."""
MIN_MODEL_IMAGES = 3
"""Images of the smallest model that COLMAP keeps."""
LENS_GAIN = 0.03
"""Least fraction by which a radial distortion lowers the residuals, for it to be believed."""
LENS_SHIFT_PX = 0.5
"""Least shift of an image's corners by a distortion that is believed."""
LOSS_SCALE_PX = 1.0
"""Residual from which on a point counts less in the last bundle adjustment."""
MIN_FACE_VIEWS = 2
"""Images in which a point lies on the face, for it to be one of the head."""
PERSON_PROBABILITY = 0.5
"""Probability above which a pixel belongs to the person."""
DATABASE = "features.db"
IMAGES_FOLDER = "images"
MASKS_FOLDER = "masks"
MODELS_FOLDER = "models"


@dataclass(frozen=True)
class Structure:
    """Result of structure from motion.

    timesteps   (N,) of the images that have a pose
    poses       (N, 3, 4) from the world, whose unit is free, to OpenCV's camera axes
    focal_px    focal length of all images
    distortion  k of 1 + k r²; 0 for a pinhole
    points      how many points were found
    on_head     how many of them lie on the face
    error_px    mean reprojection error
    masked      whether only the person was looked at, who turned in front of a room that does not
    """

    timesteps: np.ndarray
    poses: np.ndarray
    focal_px: float
    distortion: float
    points: int
    on_head: int
    error_px: float
    masked: bool

    @classmethod
    def of_arrays(cls, arrays: Mapping[str, np.ndarray]) -> "Structure":
        """What `find_structure` returned."""
        focal, distortion, error = arrays["lens"].tolist()
        points, on_head, masked = arrays["counts"].tolist()
        poses = arrays["poses"]
        timesteps = arrays["timesteps"]
        return cls(timesteps, poses, focal, distortion, points, on_head, error, bool(masked))

    def arrays(self) -> dict[str, np.ndarray]:
        return {
            "timesteps": self.timesteps,
            "poses": self.poses,
            "lens": np.array([self.focal_px, self.distortion, self.error_px]),
            "counts": np.array([self.points, self.on_head, int(self.masked)]),
        }


@dataclass(frozen=True)
class SearchOptions:
    """How structure from motion works.

    focal_px      focal length that is known or assumed; None: found without
    keeps_focal   whether it is exact
    in_order      whether images follow each other in time
    threads       that COLMAP may use
    min_images, min_on_head   images and points on the face below which only the person is looked
                  at
    """

    focal_px: float | None
    keeps_focal: bool
    in_order: bool
    threads: int
    min_images: int
    min_on_head: int


def find_structure(
    camera: FootageCamera,
    timesteps: Sequence[int],
    options: SearchOptions,
    folder: Path,
    step: Step,
) -> dict[str, np.ndarray]:
    """`Structure.arrays` of the images of one lens. folder: for files, removed at the end. step: is
    called once an image for its features, its matches and its pose. Without any model, of no
    image."""
    shutil.rmtree(folder, ignore_errors=True)
    try:
        names = {}
        for number, timestep in enumerate(timesteps):
            names[f"{number:04d}.png"] = timestep
            image = camera.image(timestep)
            write_png(folder / IMAGES_FOLDER / f"{number:04d}.png", image[..., ::-1])
        search = _Search(camera, names, options, folder)
        found = search.structure(False, step)
        if len(found.timesteps) < options.min_images or found.on_head < options.min_on_head:
            search.write_masks()
            masked = search.structure(True, lambda: None)
            found = max(
                found, masked, key=lambda structure: (structure.on_head, len(structure.timesteps))
            )
        return found.arrays()
    finally:
        shutil.rmtree(folder, ignore_errors=True)


class _Search:
    """Images in a folder, by name with their timesteps, whose cameras are sought."""

    def __init__(
        self,
        camera: FootageCamera,
        names: Mapping[str, int],
        options: SearchOptions,
        folder: Path,
    ) -> None:
        import pycolmap

        self._colmap: Any = pycolmap
        pycolmap.logging.minloglevel = int(pycolmap.logging.FATAL)
        self._camera = camera
        self._names = names
        self._options = options
        self._folder = folder
        self._faces: dict[str, np.ndarray] | None = None

    def structure(self, masked: bool, step: Step) -> Structure:
        """The largest model, of all that images show or of the person alone."""
        colmap = self._colmap
        colmap.set_random_seed(SEED)
        database = self._folder / DATABASE
        database.unlink(missing_ok=True)
        self._extract(masked, step)
        self._match(step)
        best = self._mapped(step)
        is_lacking = best is not None and best.num_reg_images() < len(self._names)
        if is_lacking and not self._options.keeps_focal:
            best = self._mapped_again(best)
        if best is None:
            none = np.zeros((0, 3, 4))
            return Structure(np.zeros(0, np.int64), none, 0.0, 0.0, 0, 0, 0.0, masked)
        best = self._with_lens(best)
        images = sorted((image for image in best.images.values() if image.has_pose), key=_name)
        (lens,) = best.cameras.values()
        focal, _, _, *distortion = lens.params.tolist()
        return Structure(
            np.array([self._names[image.name] for image in images]),
            np.stack([image.cam_from_world().matrix() for image in images]),
            focal,
            distortion[0] if distortion else 0.0,
            best.num_points3D(),
            self._on_head(best),
            best.compute_mean_reprojection_error(),
            masked,
        )

    def write_masks(self) -> None:
        """Images of where the person is, as COLMAP names them."""
        person = PersonNetwork()
        for name, timestep in self._names.items():
            is_person = person.probability(self._camera.image(timestep)) > PERSON_PROBABILITY
            write_png(self._folder / MASKS_FOLDER / f"{name}.png", 255 * is_person.astype(np.uint8))

    def _extract(self, masked: bool, step: Step) -> None:
        colmap = self._colmap
        reader = colmap.ImageReaderOptions()
        reader.camera_model = "SIMPLE_PINHOLE"
        size = self._camera.camera.width, self._camera.camera.height
        focal = self._options.focal_px
        if focal is not None:
            reader.camera_params = f"{float(focal)!r},{size[0] / 2!r},{size[1] / 2!r}"
        if masked:
            reader.mask_path = str(self._folder / MASKS_FOLDER)
        extraction = colmap.FeatureExtractionOptions()
        extraction.num_threads = self._options.threads
        extraction.max_image_size = MAX_IMAGE_PX
        extraction.sift.first_octave = -1 if max(size) <= DOUBLED_IMAGE_PX else 0
        extraction.sift.max_num_features = MAX_FEATURES
        extraction.sift.peak_threshold = PEAK_THRESHOLD
        extraction.sift.edge_threshold = EDGE_THRESHOLD
        extraction.sift.upright = True
        names = list(self._names)
        mode = colmap.CameraMode.SINGLE
        for first in range(0, len(names), self._options.threads):
            part = names[first : first + self._options.threads]
            colmap.extract_features(
                self._folder / DATABASE,
                self._folder / IMAGES_FOLDER,
                image_names=part,
                camera_mode=mode,
                reader_options=reader,
                extraction_options=extraction,
            )
            reader.existing_camera_id = 1
            for _ in part:
                step()

    def _match(self, step: Step) -> None:
        """Image by image, its pairs with those before it: all, or of a video the near ones."""
        colmap = self._colmap
        matching = colmap.FeatureMatchingOptions()
        matching.num_threads = self._options.threads
        verification = colmap.TwoViewGeometryOptions()
        verification.ransac.random_seed = SEED
        pairs = self._folder / "pairs.txt"
        names = list(self._names)
        for number, name in enumerate(names):
            if number:
                lines = (f"{names[other]} {name}" for other in self._compared(number))
                pairs.write_text("\n".join(lines), encoding="ascii")
                pairing = colmap.ImportedPairingOptions()
                pairing.match_list_path = str(pairs)
                colmap.match_image_pairs(
                    self._folder / DATABASE,
                    matching_options=matching,
                    pairing_options=pairing,
                    verification_options=verification,
                )
            step()

    def _compared(self, number: int) -> list[int]:
        """The images before one that it is compared with."""
        if not self._options.in_order:
            return list(range(number))
        loops = range(0, number, LOOP_STEP) if number % LOOP_STEP == 0 else ()
        return sorted({*range(max(0, number - NEAR_IMAGES), number), *loops})

    def _mapped(self, step: Step) -> Any | None:
        """COLMAP's largest model; None where it finds none."""
        colmap = self._colmap
        options = colmap.IncrementalPipelineOptions()
        options.num_threads = self._options.threads
        options.random_seed = SEED
        options.mapper.random_seed = SEED
        options.triangulation.random_seed = SEED
        options.min_model_size = MIN_MODEL_IMAGES
        options.extract_colors = False
        options.ba_global_frames_ratio = options.ba_global_points_ratio = MODEL_GROWTH
        options.ba_global_max_refinements = MAX_ADJUSTMENTS
        options.ba_global_max_num_iterations = MAX_ADJUSTMENT_ITERATIONS
        options.ba_refine_focal_length = not self._options.keeps_focal
        options.mapper.abs_pose_refine_focal_length = not self._options.keeps_focal
        models = self._folder / MODELS_FOLDER
        models.mkdir(exist_ok=True)
        found = colmap.incremental_mapping(
            self._folder / DATABASE,
            self._folder / IMAGES_FOLDER,
            models,
            options=options,
            next_image_callback=step,
        )
        return max(found.values(), key=_observations, default=None)

    def _mapped_again(self, found: Any) -> Any:
        """The model, or the one that COLMAP finds from its focal length, whichever observes points
        more often: from a wrong focal length, images are lost. Where none is, cameras are the same
        after the last adjustment."""
        database = self._colmap.Database.open(self._folder / DATABASE)
        (camera,) = database.read_all_cameras()
        (known,) = found.cameras.values()
        camera.params = [known.params[0], *camera.params[1:]]
        database.update_camera(camera)
        database.close()
        again = self._mapped(lambda: None)
        return found if again is None else max(found, again, key=_observations)

    def _with_lens(self, model: Any) -> Any:
        """The model after a last, robust bundle adjustment, with a radial distortion where the
        residuals clearly require one."""
        colmap = self._colmap
        self._adjust(model)
        radial = colmap.Reconstruction(model)
        (camera,) = radial.cameras.values()
        camera.model = colmap.CameraModelId.SIMPLE_RADIAL
        camera.params = [*camera.params.tolist(), 0.0]
        self._adjust(radial)
        (focal, cx, cy, k) = camera.params.tolist()
        shift_px = abs(k) * np.hypot(cx, cy) ** 3 / focal**2
        before = model.compute_mean_reprojection_error()
        after = radial.compute_mean_reprojection_error()
        is_distorted = after < (1 - LENS_GAIN) * before and shift_px > LENS_SHIFT_PX
        return radial if is_distorted else model

    def _adjust(self, model: Any) -> None:
        colmap = self._colmap
        options = colmap.BundleAdjustmentOptions()
        options.refine_focal_length = not self._options.keeps_focal
        options.refine_extra_params = True
        options.print_summary = False
        options.ceres.loss_function_type = colmap.LossFunctionType.CAUCHY
        options.ceres.loss_function_scale = LOSS_SCALE_PX
        options.ceres.solver_options.num_threads = self._options.threads
        config = colmap.BundleAdjustmentConfig()
        for image in model.reg_image_ids():
            config.add_image(image)
        config.fix_gauge(colmap.BundleAdjustmentGauge.TWO_CAMS_FROM_WORLD)
        # bundle adjustment writes to the log at any level
        colmap.create_default_bundle_adjuster(options, config, model).solve()
        model.update_point_3d_errors()

    def _on_head(self, model: Any) -> int:
        """How many points lie on the face in MIN_FACE_VIEWS of the images that have a pose."""
        if self._faces is None:
            self._faces = self._found_faces()
        views = dict[int, int]()
        for image in model.images.values():
            box = self._faces.get(image.name)
            if not image.has_pose or box is None:
                continue
            found = [point for point in image.points2D if point.has_point3D()]
            places = np.array([point.xy for point in found]).reshape(-1, 2)
            is_inside = ((box[0] <= places) & (places <= box[1])).all(axis=1)
            for point in itertools.compress(found, is_inside):
                views[point.point3D_id] = views.get(point.point3D_id, 0) + 1
        return sum(count >= MIN_FACE_VIEWS for count in views.values())

    def _found_faces(self) -> dict[str, np.ndarray]:
        """Image -> (2, 2) corners of the face that it shows."""
        networks = FaceNetworks()
        boxes = {}
        near = None
        for name, timestep in self._names.items():
            faces = networks.find(self._camera.image(timestep), near)
            if faces:
                near = faces[0]
                boxes[name] = np.stack([near.min(0), near.max(0)])
        return boxes


def _observations(model: Any) -> int:
    return int(model.compute_num_observations())


def _name(image: Any) -> str:
    return str(image.name)
