/** All scenes, newest first, and the place to drop a new scan. */

import { useCallback, useEffect, useState } from "preact/hooks";
import { asProblem } from "../api/client";
import { listScenes } from "../api/service";
import type { Problem, Scene } from "../api/types";
import { t } from "../text";
import { ProblemNote } from "../ui/problem";
import { SceneCard } from "./card";
import { UploadPanel, useUpload } from "./upload";

/** How often the list is looked at while something is being parsed, milliseconds. */
const LOOK_EVERY = 2500;

export function ScenesPlace({ onReady }: { onReady: () => void }) {
  const [scenes, setScenes] = useState<Scene[] | null>(null);
  const [next, setNext] = useState<string | null>(null);
  const [problem, setProblem] = useState<Problem | null>(null);

  const load = useCallback(async () => {
    try {
      const page = await listScenes();
      // Pages that were opened stay open.
      setScenes((old) => [...page.scenes, ...(old ?? []).filter(({ id }) => id < (page.scenes.at(-1)?.id ?? "")).filter(notIn(page.scenes))]);
      setNext((old) => old ?? page.next_cursor ?? null);
      setProblem(null);
    } catch (thrown) {
      setProblem(asProblem(thrown));
    }
  }, []);

  const upload = useUpload(() => void load());

  const loadMore = async () => {
    try {
      const page = await listScenes(next);
      setScenes((old) => [...(old ?? []), ...page.scenes.filter(notIn(old ?? []))]);
      setNext(page.next_cursor ?? null);
    } catch (thrown) {
      setProblem(asProblem(thrown));
    }
  };

  useEffect(() => {
    document.title = `${t.scenes.title} · ${t.title}`;
    void load().then(onReady);
  }, []);

  const waiting = scenes?.some(({ status }) => status === "parsing") ?? false;
  useEffect(() => {
    if (!waiting) return;
    const looking = setInterval(() => void load(), LOOK_EVERY);
    return () => clearInterval(looking);
  }, [waiting]);

  const gone = (id: string) => setScenes((old) => old?.filter((scene) => scene.id !== id) ?? null);
  const changed = (scene: Scene) => setScenes((old) => old?.map((one) => (one.id === scene.id ? scene : one)) ?? null);

  return (
    <div class="place">
      <h1>{t.scenes.title}</h1>
      <UploadPanel upload={upload} />
      {problem && <ProblemNote problem={problem} onAgain={() => void load()} />}
      {!scenes && !problem && <p class="wait">{t.loading}</p>}
      {scenes?.length === 0 && (
        <div class="empty">
          <p>
            <b>{t.scenes.empty}</b> {t.scenes.emptyHint}
          </p>
          <button type="button" class="main" disabled={upload.step.at !== "idle"} onClick={() => void upload.takeSample()}>
            {t.scenes.sample}
          </button>
        </div>
      )}
      <ul class="cards">
        {scenes?.map((scene) => <SceneCard key={scene.id} scene={scene} onGone={gone} onChanged={changed} />)}
      </ul>
      {next && (
        <button type="button" onClick={() => void loadMore()}>
          {t.more}
        </button>
      )}
    </div>
  );
}

const notIn = (scenes: Scene[]) => (scene: Scene) => scenes.every(({ id }) => id !== scene.id);
