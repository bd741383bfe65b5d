"""The chain that runs, from events to the page's buffer, and what the page asks of it."""

import threading
import traceback

from src.live_view.faults import Faults
from src.live_view.intake import Intake
from src.live_view.meters import Meters
from src.live_view.reconstruction import Reconstruction

JOIN_S = 2.0  # for which a thread is waited for at the end


class Player:
    """Four threads: decoding, cutting, events, network.  What waits between two is bounded."""

    def __init__(
        self, intake: Intake, reconstruction: Reconstruction, meters: Meters, faults: Faults
    ):
        self.intake, self.reconstruction = intake, reconstruction
        self.meters, self.faults = meters, faults
        self.stopped = threading.Event()
        laying, running = reconstruction.lay_events, reconstruction.run_network
        works = (intake.decode, intake.cut, laying, running)
        self.threads = [
            threading.Thread(target=self._guarded, args=(work,), name=work.__name__, daemon=True)
            for work in works
        ]

    def start(self) -> None:
        """Start playing."""
        for thread in self.threads:
            thread.start()

    def stop(self) -> None:
        """End the threads and let go of the feed."""
        self.stopped.set()
        for thread in self.threads:
            if thread.ident is not None:
                thread.join(JOIN_S)
        self.intake.feed.close()

    def _guarded(self, work) -> None:
        try:
            work(self.stopped)
        except Exception as error:  # a thread that ends must not end unseen
            traceback.print_exc()
            self.faults.tell("thread", f"{work.__name__} ended: {error}", stays=True)
            self.intake.state = "broken"

    @property
    def paused(self) -> bool:
        """Whether the pictures stand still."""
        return not self.intake.pace.running.is_set()

    def pause(self, paused: bool) -> None:
        """Hold the pictures, or go on.  What a live stream sends meanwhile is left out."""
        running = self.intake.pace.running
        (running.clear if paused else running.set)()

    def status(self) -> dict:
        """Return what `GET /status` answers, all but the page's own."""
        intake, level = self.intake, self.reconstruction.level
        held = self.paused and intake.state != "broken"
        return {
            "state": "paused" if held else intake.state,
            "paused": self.paused,
            "faults": self.faults.now(),
            "asked_fps": intake.asked_fps(),
            **self.meters.rates(),
            "dropped": intake.backlog.dropped,
            "waiting": len(intake.backlog),
            "network": level.network if level else None,
            "views": level.views if level else None,
            "load": self.meters.load(),
            "time_s": round(intake.cutter.last * 1e-6, 3),
        }
