"""What boxes and answers can do besides holding what the server said: numpy arrays, short texts, rows of a table."""

from __future__ import annotations

import dataclasses
import importlib
from collections.abc import Iterable, Mapping
from typing import TYPE_CHECKING, Any, Optional, SupportsIndex, overload

import httpx
import numpy as np
import numpy.typing as npt
from numpy.lib.mixins import NDArrayOperatorsMixin

from uniground import _notebook

if TYPE_CHECKING:
    import pandas

    from uniground import models

Array = npt.NDArray[np.float64]


class Vector(NDArrayOperatorsMixin, list[float]):
    """Numbers of a reply: a list that computes like a numpy array.

    `+`, `-`, `*`, `/`, `<` and numpy's functions and methods work element by element and return arrays. JSON, unpacking and `==` (one
    truth value) work as for any list.
    """

    # One truth value, so that answers can be compared.
    __eq__ = list.__eq__
    __ne__ = list.__ne__
    __hash__ = None

    def __array__(self, dtype: Any = None, copy: Optional[bool] = None) -> npt.NDArray[Any]:
        return np.array(list(self), dtype=float if dtype is None else dtype)

    def __array_ufunc__(self, ufunc: np.ufunc, method: str, *inputs: Any, **options: Any) -> Any:
        into = options.pop("out", ())
        arrays = [np.asarray(value) if isinstance(value, Vector) else value for value in inputs]
        if not any(isinstance(value, Vector) for value in into):
            return getattr(ufunc, method)(*arrays, **options, **({"out": into} if into else {}))
        # `center += 1`
        into[0][:] = getattr(ufunc, method)(*arrays, **options).tolist()
        return into[0]

    @overload
    def __getitem__(self, key: SupportsIndex) -> float: ...
    @overload
    def __getitem__(self, key: slice) -> Vector: ...
    @overload
    def __getitem__(self, key: Any) -> Any: ...
    def __getitem__(self, key: Any) -> Any:
        if isinstance(key, slice):
            return Vector(super().__getitem__(key))
        return super().__getitem__(key) if isinstance(key, (int, np.integer)) else np.asarray(self)[key]

    def __getattr__(self, name: str) -> Any:
        """`shape`, `mean`, `round` and everything else that arrays have and lists do not."""
        if name.startswith("_"):
            raise AttributeError(name)
        return getattr(np.asarray(self), name)

    def copy(self) -> Vector:
        return Vector(self)


class ShortRepr:
    """Of replies with many fields: one line. `dataclasses.asdict` returns all of them."""

    def __repr__(self) -> str:
        # Every class with it is a dataclass, which the generator makes.
        fields = {field.name: getattr(self, field.name) for field in dataclasses.fields(self)}  # type: ignore[arg-type]
        shown = [f"{name}={_short(value)}" for name, value in fields.items() if isinstance(value, (str, int, float))][:5]
        return f"{type(self).__name__}({', '.join(shown)}{'' if len(shown) == len(fields) else ', …'})"


class BoxMethods:
    """Of axis-aligned boxes, and of boxes turned about the vertical. World frame: metres, Z up."""

    center: Vector
    size: Vector

    def __post_init__(self) -> None:
        self.center, self.size = Vector(self.center), Vector(self.size)

    def __repr__(self) -> str:
        center, size = (", ".join(f"{length:.3f}" for length in of) for of in (self.center, self.size))
        turned = f", yaw_rad={self._yaw():.3f}" if hasattr(self, "yaw_rad") else ""
        return f"{type(self).__name__}(center=[{center}], size=[{size}]{turned})"

    def array(self) -> Array:
        """Centre, full size and yaw: `(cx, cy, cz, dx, dy, dz, yaw)`."""
        return np.array([*self.center, *self.size, self._yaw()])

    def rotation(self) -> Array:
        """3x3, from the box's own axes to the world's."""
        c, s = np.cos(self._yaw()), np.sin(self._yaw())
        return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])

    def corners(self) -> Array:
        """The eight corners, 8x3: the lower four first, counter-clockwise seen from above, then those above them."""
        signs = np.array([(x, y, z) for z in (-1, 1) for x, y in ((-1, -1), (1, -1), (1, 1), (-1, 1))])
        own = signs * np.asarray(self.size) / 2
        corners: Array = own @ self.rotation().T + np.asarray(self.center)
        return corners

    def contains(self, points: npt.ArrayLike) -> npt.NDArray[np.bool_]:
        """Which of these points (Nx3) lie inside."""
        own = (np.asarray(points, dtype=float) - np.asarray(self.center)) @ self.rotation()
        inside: npt.NDArray[np.bool_] = (np.abs(own) <= np.asarray(self.size) / 2).all(axis=1)
        return inside

    def _yaw(self) -> float:
        return float(getattr(self, "yaw_rad", 0.0))


class ThingMethods(ShortRepr):
    """Of instances, and of things that changed between two looks."""

    if TYPE_CHECKING:
        id: int
        label: str
        box: models.Aabb

    @property
    def name(self) -> str:
        """What it is called: what a person said, else a language model, else the encoder (`label` of the HTTP API)."""
        return getattr(self, "given_name", None) or getattr(self, "model_name", None) or self.label

    def __repr__(self) -> str:
        return f"{type(self).__name__}({self.id}, {self.name!r}, {self.box!r})"


class AnswerMethods:
    """Of answers."""

    if TYPE_CHECKING:
        id: str
        query: str
        status: models.Status
        answer: models.SixFields
        confidence: float
        alternatives: list[models.Alternative]
        box: Optional[models.Aabb]
        count: Optional[int]
        evidence: Optional[list[str]]
        targets: list[models.Target]

    # Where the pictures of the answer are. Not a field: neither compared, nor copied, nor part of `asdict`.
    _http: Optional[httpx.Client] = None

    @property
    def name(self) -> Optional[str]:
        """What the thing is called, without regard to the question."""
        found = self.answer.predicted_id
        return None if found is None else self.answer.candidate_names.get(str(found))

    def boxes(self) -> Array:
        """Boxes of all things that are meant, Nx7, as `boxes` gives them."""
        return boxes(self.targets)

    def __getstate__(self) -> dict[str, Any]:
        return {name: value for name, value in self.__dict__.items() if name != "_http"}

    def __repr__(self) -> str:
        found = "" if self.name is None else f", {self.name!r} ({self.answer.predicted_id})"
        return f"{type(self).__name__}({_short(self.query)}, {self.status}{found}, confidence {self.confidence:.2f})"

    def _repr_html_(self) -> str:
        return _notebook.answer(self, _notebook.picture(self._http, self.evidence or []))

    def __str__(self) -> str:
        if self.box is None:
            return f"{self.query}: {self.status}. {self.answer.explanation}"
        center, size = (" ".join(f"{length:.2f}" for length in of) for of in (self.box.center, self.box.size))
        found = f"{self.name or 'something'} (instance {self.answer.predicted_id})"
        several = f", and {len(self.targets) - 1} more" if len(self.targets) > 1 else ""
        sure = f"confidence {self.confidence:.2f}"
        return f"{self.query}: {self.status}, {found}{several}, {sure}, centre ({center}) m, size ({size}) m"


def boxes(things: Iterable[Any]) -> Array:
    """Boxes of targets, candidates, alternatives or instances, Nx7: centre, full size, yaw (0 where only `box` is known)."""
    rows = [(getattr(thing, "oriented_box", None) or thing.box).array() for thing in things]
    return np.array(rows) if rows else np.empty((0, 7))


def row(of: models.Answer | models.BatchResult | models.InstanceView) -> dict[str, Any]:
    """One row of a table; columns are called as in the service's CSV, which has fewer."""
    # Models stand on this module, so it knows them by what they have.
    if hasattr(of, "support"):
        return _instance_row(of)
    return _result_row(of) if hasattr(of, "item") else _answer_row(of)


def table(of: Iterable[models.Answer | models.BatchResult | models.InstanceView]) -> pandas.DataFrame:
    """Answers, results of a batch or instances as a pandas table (`pip install 'uniground[pandas]'`)."""
    rows: pandas.DataFrame = wanted("pandas").DataFrame([row(one) for one in of])
    return rows


def _short(value: Any) -> str:
    text = f"{value:.4g}" if isinstance(value, float) else repr(value)
    return text if len(text) <= 60 else f"{text[:58]}…{text[-1]}"


def wanted(name: str) -> Any:
    """A library that is installed only where it is asked for."""
    try:
        return importlib.import_module(name)
    except ImportError as error:
        raise ImportError(f"this wants {name}: pip install 'uniground[{name}]'") from error


def _result_row(result: Any) -> dict[str, Any]:
    asked = {"scene_id": result.scene_id, "query": result.query, "status": result.status}
    answer = asked if result.answer is None else _answer_row(result.answer)
    code, detail = (None, None) if result.error is None else (result.error.code, result.error.detail)
    return {"item": result.item, **answer, "error_code": code, "error": detail}


def _answer_row(answer: Any) -> dict[str, Any]:
    fields: Mapping[str, Any] = {
        "scene_id": answer.scene_id,
        "query": answer.query,
        "status": answer.status,
        "answer_id": answer.id,
        "predicted_id": answer.answer.predicted_id,
        "name": answer.name,
        "confidence": answer.confidence,
        "count": answer.count,
    }
    return {
        **fields,
        **_box_columns(answer.box),
        "anchor_id": answer.answer.anchor_id,
        "no_match_reason": answer.no_match_reason,
        "explanation": answer.answer.explanation,
        "degraded": answer.degraded,
        "cost_usd": answer.usage.cost_usd,
        "total_ms": answer.timings_ms.total,
    }


def _instance_row(instance: Any) -> dict[str, Any]:
    return {
        "id": instance.id,
        "level": instance.level,
        "name": instance.name,
        "structure": instance.structure,
        "support": instance.support.on,
        "support_id": instance.support.id,
        **_box_columns(instance.box),
        "height_above_floor_m": instance.height_above_floor_m,
        "point_count": instance.point_count,
    }


def _box_columns(box: Optional[models.Aabb]) -> dict[str, float | None]:
    values = [None] * 6 if box is None else [*box.center, *box.size]
    return dict(zip(["center_x", "center_y", "center_z", "size_x", "size_y", "size_z"], values))
