/** What the page asks of the service, a function each. */

import { json, request, send } from "./client";
import type {
  Answer, AnswerList, AnswerPrompt, AnswerReply, Batch, BatchList, BatchRequest, Change, Correction, CorrectionList, Created, FrameList,
  GroundRequest, InstanceList, InstanceView, Job, ModelList, Scene, SceneList, SceneReport,
} from "./types";

const id = encodeURIComponent;

export const listScenes = (cursor?: string | null, signal?: AbortSignal) =>
  json<SceneList>(`/v1/scenes?limit=50${cursor ? `&cursor=${id(cursor)}` : ""}`, { signal });
export const getScene = (scene: string, signal?: AbortSignal) => json<Scene>(`/v1/scenes/${id(scene)}`, { signal });
/** The room that the program brings along. */
export const sendSample = () => send<Created>("POST", "/v1/scenes/sample");
export const renameScene = (scene: string, name: string) => send<Scene>("PATCH", `/v1/scenes/${id(scene)}`, { name });
export const deleteScene = (scene: string) => request(`/v1/scenes/${id(scene)}`, { method: "DELETE" });
export const parseAgain = (scene: string) => send<Job>("POST", `/v1/scenes/${id(scene)}/parse`, {});
export const nameThings = (scene: string) => send<Job>("POST", `/v1/scenes/${id(scene)}/names`);
export const getReport = (scene: string, signal?: AbortSignal) => json<SceneReport>(`/v1/scenes/${id(scene)}/report`, { signal });
export const getModels = () => json<ModelList>("/v1/models");

export const getJob = (job: string) => json<Job>(`/v1/jobs/${id(job)}`);
export const cancelJob = (job: string) => send<Job>("DELETE", `/v1/jobs/${id(job)}`);

export const ground = (scene: string, question: GroundRequest, signal?: AbortSignal) =>
  send<Answer>("POST", `/v1/scenes/${id(scene)}/ground`, question, signal);
export const getAnswer = (answer: string) => json<Answer>(`/v1/answers/${id(answer)}`);
export const listAnswers = (scene: string, limit: number, cursor?: string | null) =>
  json<AnswerList>(`/v1/answers?scene_id=${id(scene)}&limit=${limit}${cursor ? `&cursor=${id(cursor)}` : ""}`);
/** The first hundred answers of a batch about a scene, within a time. */
export const batchAnswers = (scene: string, batch: string, since: Date, until: Date) =>
  json<AnswerList>(
    `/v1/answers?scene_id=${id(scene)}&batch_id=${id(batch)}&since=${since.toISOString()}&until=${until.toISOString()}&limit=100`,
  );
export const getPrompt = (answer: string, signal?: AbortSignal) => json<AnswerPrompt>(`/v1/answers/${id(answer)}/prompt`, { signal });
export const getReply = (answer: string, signal?: AbortSignal) => json<AnswerReply>(`/v1/answers/${id(answer)}/reply`, { signal });

export const listBatches = (cursor?: string | null) => json<BatchList>(`/v1/batches?limit=50${cursor ? `&cursor=${id(cursor)}` : ""}`);
export const getBatch = (batch: string) => json<Batch>(`/v1/batches/${id(batch)}`);
export const createBatch = (batch: BatchRequest) => send<Batch>("POST", "/v1/batches", batch);
export const steerBatch = (batch: string, what: "pause" | "resume" | "cancel") => send<Batch>("POST", `/v1/batches/${id(batch)}/${what}`);

/** Everything found in a scene, parts and wholes included. */
export async function allInstances(scene: string, signal?: AbortSignal): Promise<InstanceView[]> {
  const all: InstanceView[] = [];
  let cursor: number | null | undefined = 0;
  while (cursor != null) {
    const page: InstanceList = await json<InstanceList>(`/v1/scenes/${id(scene)}/instances?level=all&limit=1000&cursor=${cursor}`, { signal });
    all.push(...page.instances);
    cursor = page.next_cursor;
  }
  return all;
}

export const listFrames = (scene: string) => json<FrameList>(`/v1/scenes/${id(scene)}/frames`);

export const listCorrections = (scene: string) => json<CorrectionList>(`/v1/scenes/${id(scene)}/corrections`);
export const makeCorrection = (scene: string, change: Change) => send<Correction>("POST", `/v1/scenes/${id(scene)}/corrections`, change);
export const undoCorrection = (scene: string, correction: string) =>
  send<Correction>("DELETE", `/v1/scenes/${id(scene)}/corrections/${id(correction)}`);

export const annotationsPath = (scene: string) => `/v1/scenes/${id(scene)}/annotations`;
export const pointsPath = (scene: string) => `/v1/scenes/${id(scene)}/points.bin`;
export const cloudPath = (scene: string) => `/v1/scenes/${id(scene)}/cloud.ply`;
export const instancesCloudPath = (scene: string) => `/v1/scenes/${id(scene)}/instances.ply`;
export const viewPath = (scene: string, instance: number, view: number, picture: "frame" | "crop") =>
  `/v1/scenes/${id(scene)}/instances/${instance}/views/${view}.jpg?picture=${picture}`;
/** A photograph as it was taken, or with the objects colored. */
export const photographPath = (scene: string, frame: number, instances: boolean) =>
  `/v1/scenes/${id(scene)}/frames/${frame}/photograph.jpg?instances=${instances}`;
export const thumbnailPath = (scene: string) => `/v1/scenes/${id(scene)}/thumbnail.jpg`;
export const resultsPath = (batch: string, format: "jsonl" | "csv", follow = false) =>
  `/v1/batches/${id(batch)}/results?format=${format}${follow ? "&follow=true" : ""}`;
