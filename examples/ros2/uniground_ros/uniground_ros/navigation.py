"""Goals for Nav2: a client of its action `navigate_to_pose`."""

from __future__ import annotations

import threading
from collections.abc import Callable

from action_msgs.msg import GoalStatus
from geometry_msgs.msg import PoseStamped
from nav2_msgs.action import NavigateToPose
from rclpy.action import ActionClient

# How long to wait for Nav2 before a goal is given up.
SERVER_TIMEOUT_S = 2.0
ENDED = {
    GoalStatus.STATUS_SUCCEEDED: "succeeded",
    GoalStatus.STATUS_CANCELED: "canceled",
    GoalStatus.STATUS_ABORTED: "aborted",
}


class Navigator:
    """Sends one goal at a time; Nav2 drops an earlier one for it.

    `on_state` is told `unavailable`, `sent`, `accepted` or `rejected`, and in the end `succeeded`, `canceled` or `aborted`.
    """

    def __init__(self, node, action: str, callback_group, on_state: Callable[[str], None]) -> None:
        self.client = ActionClient(node, NavigateToPose, action, callback_group=callback_group)
        self.on_state = on_state
        # Replies come on other threads. Those to an earlier goal say nothing about the current one.
        self.lock = threading.RLock()
        self.sent = 0
        self.current: int | None = None
        self.handle = None

    def send(self, goal: PoseStamped) -> bool:
        """Whether Nav2 is there to be sent the goal. What it replies goes to `on_state`."""
        if not self.client.wait_for_server(timeout_sec=SERVER_TIMEOUT_S):
            self.on_state("unavailable")
            return False
        with self.lock:
            self.sent += 1
            number = self.current = self.sent
            self.handle = None
            self.on_state("sent")
        future = self.client.send_goal_async(NavigateToPose.Goal(pose=goal))
        future.add_done_callback(lambda reply: self.on_reply(number, reply.result()))
        return True

    def cancel(self) -> bool:
        """Whether there was a goal to cancel."""
        with self.lock:
            if self.current is None:
                return False
            if self.handle is None:
                # Nav2 has not replied yet: `on_reply` cancels it then.
                self.current = None
                self.on_state("canceled")
            else:
                self.handle.cancel_goal_async()
            return True

    def on_reply(self, number: int, handle) -> None:
        with self.lock:
            if number != self.current:
                if handle.accepted:
                    handle.cancel_goal_async()
                return
            self.on_state("accepted" if handle.accepted else "rejected")
            if not handle.accepted:
                self.current = None
                return
            self.handle = handle
        handle.get_result_async().add_done_callback(lambda ended: self.on_end(number, ended.result().status))

    def on_end(self, number: int, status: int) -> None:
        with self.lock:
            if number == self.current:
                self.current = self.handle = None
                self.on_state(ENDED.get(status, "aborted"))
