/** A room whose scan is not parsed yet: what the server does with it, and a question that is asked when the room is ready. */

import { useEffect, useState } from "preact/hooks";
import { asProblem } from "../api/client";
import { parseAgain } from "../api/service";
import type { Problem } from "../api/types";
import { JobProgress } from "../scenes/job";
import { t } from "../text";
import { ModelsNote } from "../ui/models";
import { narrow } from "../ui/narrow";
import { ofJob, ProblemNote } from "../ui/problem";
import { AskForm } from "./ask";
import { DraftCanvas } from "./draft";
import type { Room } from "./state";

/** For each of the steps that are listed, the stages of a parse that belong to it. */
const STEPS = [
  ["import", "check_reprojection", "levelling", "fuse_cloud", "look_through", "check_pictures"],
  ["superpoints"],
  ["masks_and_lifting", "growth"],
  ["planes", "gaps", "merge", "merging", "join_parts", "part_merging", "hierarchy", "refine", "refinement"],
  ["views", "instances", "appearance", "frame_appearance", "write_clouds", "draw_report"],
];

export function WaitingRoom({ room, onReady }: { room: Room; onReady: () => void }) {
  const scene = room.scene.value!;
  const parsing = scene.status === "parsing";
  const [imported, setImported] = useState(false);
  const [drafted, setDrafted] = useState(false);
  const ask = (
    <div class="ask-early">
      <AskForm room={room} examples={scene.name === t.welcome.sampleName ? t.welcome.questions : []} />
      <p class="small" role="status">
        {room.queued.value === null ? t.scenes.askNow : t.scenes.queued(room.queued.value)}
      </p>
    </div>
  );
  return (
    <div class="room">
      {narrow.value && parsing && ask}
      <section class="stage" aria-label={scene.name}>
        <h1 class="room-name">{scene.name}</h1>
        <div class="canvas waiting" data-draft={parsing && drafted}>
          {imported && <DraftCanvas scene={room.id} onShown={() => setDrafted(true)} />}
          {parsing ? <Parsing room={room} onReady={onReady} onImported={() => setImported(true)} /> : <NotParsed room={room} onReady={onReady} />}
        </div>
      </section>
      <section class="side">
        <div class="panel">
          {!narrow.value && parsing && ask}
          {room.models.value && <ModelsNote models={room.models.value} />}
        </div>
      </section>
    </div>
  );
}

function Parsing({ room, onReady, onImported }: { room: Room; onReady: () => void; onImported: () => void }) {
  const { job_id: job } = room.scene.value!;
  const [step, setStep] = useState(-1);
  const follow = (stage: string | null | undefined) => setStep((before) => Math.max(before, STEPS.findIndex((stages) => stages.includes(stage ?? ""))));
  useEffect(() => {
    if (step > 0) onImported();
  }, [step > 0]);
  return (
    <div class="waiting-card">
      <p>{t.scenes.draft}</p>
      {job && <JobProgress job={job} onProgress={({ stage }) => follow(stage)} onDone={onReady} onLost={onReady} />}
      <ol class="steps">
        {t.scenes.steps.map((words, i) => (
          <li key={words} data-step={i < step ? "done" : i === step ? "now" : "later"} aria-current={i === step ? "step" : undefined}>
            {words}
          </li>
        ))}
      </ol>
    </div>
  );
}

function NotParsed({ room, onReady }: { room: Room; onReady: () => void }) {
  const { id, error } = room.scene.value!;
  const [problem, setProblem] = useState<Problem | null>(null);
  const parse = () => void parseAgain(id).then(onReady, (thrown) => setProblem(asProblem(thrown)));
  return (
    <div class="waiting-card">
      {error ? <ProblemNote problem={ofJob(error, t.scenes.status.failed)} /> : <p>{t.scenes.notParsed}</p>}
      <button type="button" class="main" onClick={parse}>
        {t.scenes.parse}
      </button>
      {problem && <ProblemNote problem={problem} />}
    </div>
  );
}
