"""The typed services, where pnv_msgs is on the machine: maps by path, the places of an image, a keyframe."""

from collections.abc import Callable
from typing import Any

from msg_adapters.typed_closures import closures_to_typed, keyframe_to_typed
from pnv_core.errors import PnvError
from pnv_core.verify.feature_codes import picture_of
from pnv_ros.recognition import Recognition
from pnv_ros.saved_map import SavedMap
from pnv_ros.services import Services

Parts = Callable[[], tuple[SavedMap, Recognition]]


class TypedServices:
    """~/save_map, ~/load_map, ~/query_image and ~/get_keyframe of pnv_msgs.

    Each runs in a thread of its own, one at a time with the other services, and answers with a sentence.
    """

    def __init__(self, services: Services, parts: Parts) -> None:
        """`parts` gives the map and the recognition of a configured node, or raises PnvError."""
        self._parts = parts
        try:  # by name: in the folder of the sources the package itself is found, without anything in it
            from pnv_msgs.srv import GetKeyframe, LoadMap, QueryImage, SaveMap
        except ImportError:
            return
        for kind, name, act in (
            (SaveMap, "save_map", self._save),
            (LoadMap, "load_map", self._load),
            (QueryImage, "query_image", self._query),
            (GetKeyframe, "get_keyframe", self._keyframe),
        ):
            services.serve(kind, name, act)

    def _save(self, request: Any, _: Any) -> str:
        saved_map, _recognition = self._parts()
        return f"saved {saved_map.save(path=request.path)}"

    def _load(self, request: Any, _: Any) -> str:
        saved_map, recognition = self._parts()
        count = saved_map.load(recognition.still(), recognition.map_was_replaced, request.path)
        return f"loaded {count} keyframes from {request.path or saved_map.path}; a new session begins"

    def _query(self, request: Any, response: Any) -> str:
        _, recognition = self._parts()
        closures = recognition.where_is(request.image, request.camera)
        response.candidates = closures_to_typed(closures)
        best = f"; the best of score {closures[0].score:.2f}" if closures else ""
        return f"{len(closures)} candidates{best}"

    def _keyframe(self, request: Any, response: Any) -> str:
        _, recognition = self._parts()
        database = recognition.recognizer.database
        with recognition.still():
            if request.id not in database:
                raise PnvError(f"keyframe {request.id} is not in the map; allowed: an id of a closure or a candidate")
            picture = picture_of(database.picture(request.id))
            response.keyframe = keyframe_to_typed(database.ref(request.id), database.vector(request.id), picture)
        return f"keyframe {request.id}"
