/** Shows the progress of a job: step, share and time left. */

import { useEffect, useState } from "preact/hooks";
import { wasAborted } from "../api/client";
import { cancelJob } from "../api/service";
import { followJob } from "../api/stream";
import type { Job } from "../api/types";
import { t } from "../text";

interface Properties {
  job: string;
  onProgress?: (job: Job) => void;
  onDone?: (job: Job) => void;
  onLost?: (thrown: unknown) => void;
}

export function JobProgress({ job, onProgress, onDone, onLost }: Properties) {
  const [state, setState] = useState<Job | null>(null);
  useEffect(() => {
    const stop = new AbortController();
    const show = (state: Job) => {
      setState(state);
      onProgress?.(state);
    };
    followJob(job, show, stop.signal).then(
      (done) => onDone?.(done),
      (thrown) => !wasAborted(thrown) && onLost?.(thrown),
    );
    return () => stop.abort();
  }, [job]);
  const stage = state?.stage ?? "queued";
  return (
    <div class="job">
      <Progress share={state?.progress ?? 0} words={t.stages[stage] ?? t.otherStage} eta_s={state?.eta_s ?? null} />
      <button type="button" class="quiet" onClick={() => void cancelJob(job).catch(() => undefined)}>
        {t.upload.stop}
      </button>
    </div>
  );
}

export function Progress({ share, words, eta_s }: { share: number; words: string; eta_s: number | null }) {
  return (
    <div class="progress">
      <progress max={1} value={share} aria-label={words} />
      <span>
        {words} · {Math.round(share * 100)} %{eta_s !== null && ` · ${t.upload.left(t.seconds(eta_s))}`}
      </span>
    </div>
  );
}
