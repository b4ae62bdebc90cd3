/** Says that a room is a draft while its full parse runs, and shows the full parse when it is done. */

import { useEffect, useState } from "preact/hooks";
import { followJob } from "../api/stream";
import type { Job } from "../api/types";
import { t } from "../text";
import { say } from "../ui/say";
import type { Room } from "./state";

export function Improving({ room }: { room: Room }) {
  const { quality, job_id: id } = room.scene.value!;
  const [job, setJob] = useState<Job | null>(null);
  useEffect(() => {
    if (quality !== "draft" || !id) return;
    const stop = new AbortController();
    const show = async () => {
      const done = await followJob(id, setJob, stop.signal);
      if (done.kind !== "full_parse" || done.state !== "succeeded") return;
      await room.load(stop.signal);
      say(t.room.improved(room.scene.peek()?.counts?.instances ?? 0));
    };
    // Without the connection, the draft stays and the page can be reloaded.
    show().catch(() => undefined);
    return () => stop.abort();
  }, [quality, id]);
  const running = quality === "draft" && job?.kind === "full_parse" && (job.state === "queued" || job.state === "running");
  return running ? (
    <p class="improving small" role="status">
      {t.room.improving(job.eta_s == null ? null : t.seconds(job.eta_s))}
    </p>
  ) : null;
}
