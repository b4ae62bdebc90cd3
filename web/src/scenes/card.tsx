/** One scene in the list. */

import { useState } from "preact/hooks";
import { asProblem } from "../api/client";
import { deleteScene, parseAgain, renameScene, thumbnailPath } from "../api/service";
import type { Problem, Scene } from "../api/types";
import { address } from "../route";
import { t } from "../text";
import { numbers } from "../ui/fields";
import { Picture } from "../ui/picture";
import { ofJob, ProblemNote } from "../ui/problem";
import { RenameForm } from "../ui/rename";
import { JobProgress } from "./job";

interface Properties { scene: Scene; onGone: (id: string) => void; onChanged: (scene: Scene) => void }

export function SceneCard({ scene, onGone, onChanged }: Properties) {
  const [problem, setProblem] = useState<Problem | null>(null);
  const [renaming, setRenaming] = useState(false);
  const attempt = (work: Promise<unknown>) => work.catch((thrown) => setProblem(asProblem(thrown)));

  const remove = () => {
    if (confirm(t.scenes.confirmDelete(scene.name))) void attempt(deleteScene(scene.id).then(() => onGone(scene.id)));
  };
  const rename = (name: string) => {
    setRenaming(false);
    if (name && name !== scene.name) void attempt(renameScene(scene.id, name).then(onChanged));
  };
  const parse = () => void attempt(parseAgain(scene.id).then((job) => onChanged({ ...scene, status: "parsing", job_id: job.id, error: null })));

  const { counts, extent, status } = scene;
  const ready = status === "ready";
  const where = address(["scenes", scene.id]);
  return (
    <li class="card">
      <a class="thumb" href={where} tabIndex={-1} aria-hidden="true">
        {ready ? <Picture path={thumbnailPath(scene.id)} alt="" /> : <span class="picture" />}
      </a>
      <div class="card-body">
        <h2>{renaming ? <RenameForm name={scene.name} label={t.scenes.newName} maxLength={200} onDone={rename} /> : <a href={where}>{scene.name}</a>}</h2>
        <p class="facts">
          <span class={`badge ${status}`}>{t.scenes.status[status]}</span>
          {scene.quality === "draft" && <span>{t.scenes.isDraft}</span>}
          {counts && <span>{t.scenes.things(counts.instances)}</span>}
          {counts && <span>{t.scenes.points(counts.points)}</span>}
          {extent && <span class="figures">{numbers(extent.size, 1)} m</span>}
          <time dateTime={scene.created_at}>{t.date(scene.created_at)}</time>
        </p>
        {status === "parsing" && scene.job_id && <JobProgress job={scene.job_id} />}
        {scene.error && <ProblemNote problem={ofJob(scene.error, t.scenes.status.failed)} />}
        {problem && <ProblemNote problem={problem} />}
        <div class="buttons">
          {(status === "uploaded" || status === "failed") && (
            <button type="button" onClick={parse}>
              {t.scenes.parse}
            </button>
          )}
          {ready && (
            <a class="button quiet" href={address(["scenes", scene.id], { tab: "report" })}>
              {t.scenes.report}
            </a>
          )}
          <button type="button" class="quiet" onClick={() => setRenaming(true)}>
            {t.rename}
          </button>
          <button type="button" class="quiet" onClick={remove}>
            {t.remove}
          </button>
        </div>
      </div>
    </li>
  );
}
