"""The executable `pnv_view`: a page that shows what the node does, for a robot watched from a laptop.

A node of its own: it subscribes to what place_recognizer publishes and serves one page, no files, no network.
"""

import argparse
import json
import sys
import threading
from collections import deque
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any

import cv2
import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from rclpy.executors import ExternalShutdownException
from rclpy.node import Node
from rclpy.utilities import remove_ros_args
from sensor_msgs.msg import Image, PointCloud2
from visualization_msgs.msg import MarkerArray

from msg_adapters.images import message_to_frame
from msg_adapters.loop_closures import candidates_table
from pnv_ros.markers import MARKERS_QOS
from pnv_ros.outputs import PICTURE_QOS, TABLE_QOS
from pnv_ros.watch_page import PAGE

_KEPT = 2000  # queries and points drawn; queries: over a quarter of an hour at two keyframes a second


class Watch(Node):
    """What was heard of a place_recognizer last, as `state` and `picture`."""

    def __init__(self, name: str) -> None:
        super().__init__("pnv_view")
        self._name, self._lock = name, threading.Lock()
        self._queries: deque[tuple[float, float, float, bool]] = deque(
            maxlen=_KEPT
        )  # query s, match s, score, accepted
        self._health: dict[str, Any] = {"message": f"nothing heard of {name} yet", "level": 1, "values": {}}
        self._map: dict[str, list[list[float]]] = {"keyframes": [], "closures": []}
        self.picture = b""
        self.create_subscription(PointCloud2, f"{name}/candidates", self._candidates, TABLE_QOS)
        self.create_subscription(Image, f"{name}/match_image", self._match_image, PICTURE_QOS)
        self.create_subscription(MarkerArray, f"{name}/markers", self._markers, MARKERS_QOS)
        self.create_subscription(DiagnosticArray, "/diagnostics", self._diagnostics, 10)

    def state(self) -> dict[str, Any]:
        """What the page draws."""
        with self._lock:
            return {"queries": list(self._queries), "map": self._map, **self._health}

    def _candidates(self, message: PointCloud2) -> None:
        table = candidates_table(message)
        if len(table):
            best = table[0]
            query, match = (float(best[f"{side}_sec"]) + best[f"{side}_nsec"] / 1e9 for side in ("query", "match"))
            with self._lock:
                self._queries.append((query, match, float(best["score"]), bool(best["accepted"])))

    def _markers(self, message: MarkerArray) -> None:
        drawn = {m.ns: [[round(v, 3) for v in (p.x, p.y, p.z)] for p in m.points] for m in message.markers}
        points, lines = drawn.get("keyframes", []), drawn.get("closures", [])
        with self._lock:
            self._map = {"keyframes": points[:: 1 + len(points) // _KEPT], "closures": lines[-_KEPT:]}

    def _match_image(self, message: Image) -> None:
        rgb = message_to_frame(message, "match").rgb
        self.picture = cv2.imencode(".jpg", cv2.cvtColor(rgb, cv2.COLOR_RGB2BGR))[1].tobytes()

    def _diagnostics(self, message: DiagnosticArray) -> None:
        for status in message.status:
            if status.name.startswith(f"{self._name}:"):
                values = {pair.key: pair.value for pair in status.values}
                with self._lock:
                    self._health = {"message": status.message, "level": status.level[0], "values": values}


def serve(watch: Watch, address: tuple[str, int]) -> ThreadingHTTPServer:
    """Serves the page, its state and its picture in threads. Raises OSError for an address that cannot be had."""

    class Handler(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            path = self.path.partition("?")[0]
            if path == "/":
                self._answer("text/html; charset=utf-8", PAGE.encode())
            elif path == "/state.json":
                self._answer("application/json", json.dumps(watch.state()).encode())
            elif path == "/match.jpg" and watch.picture:
                self._answer("image/jpeg", watch.picture)
            else:
                self.send_error(404)

        def _answer(self, kind: str, body: bytes) -> None:
            self.send_response(200)
            self.send_header("Content-Type", kind)
            self.send_header("Content-Length", str(len(body)))
            self.send_header("Cache-Control", "no-store")
            self.end_headers()
            self.wfile.write(body)

        def log_message(self, *_: Any) -> None:
            pass

    server = ThreadingHTTPServer(address, Handler)
    threading.Thread(target=server.serve_forever, daemon=True).start()
    return server


def main(args: list[str] | None = None) -> int:
    """0 after SIGINT, 2 for unusable arguments."""
    given = [*sys.argv] if args is None else [sys.argv[0], *args]
    parser = argparse.ArgumentParser(prog="pnv_view", description=__doc__.splitlines()[0])
    parser.add_argument("--node", default="/place_recognizer", metavar="NAME", help="default /place_recognizer")
    parser.add_argument("--port", type=int, default=8090, help="default 8090; 0 takes a free one")
    parser.add_argument(
        "--bind", default="127.0.0.1", metavar="ADDRESS", help="default this machine only; 0.0.0.0 lets everyone watch"
    )
    options = parser.parse_args(remove_ros_args(given)[1:])
    rclpy.init(args=given)
    watch = Watch(options.node)
    try:
        server = serve(watch, (options.bind, options.port))
        print(f"http://{options.bind}:{server.server_address[1]}", flush=True)
        rclpy.spin(watch)
    except (OSError, OverflowError) as error:
        print(f"pnv_view: {options.bind}:{options.port}: {error}", file=sys.stderr)
        return 2
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
    finally:
        rclpy.try_shutdown()
    return 0


if __name__ == "__main__":
    sys.exit(main())
