/** The service's own types, by the names they have there. `schema.d.ts` is generated: `npm run types`. */

import type { components } from "./schema";

type Schemas = components["schemas"];

export type Aabb = Schemas["Aabb"];
export type Alternative = Schemas["Alternative"];
export type Answer = Schemas["Answer"];
export type AnswerList = Schemas["AnswerList"];
export type AnswerPrompt = Schemas["AnswerPrompt"];
export type AnswerReply = Schemas["AnswerReply"];
export type Batch = Schemas["Batch"];
export type BatchList = Schemas["BatchList"];
export type BatchRequest = Schemas["BatchRequest"];
export type BatchResult = Schemas["BatchResult"];
export type Candidate = Schemas["Candidate"];
export type Change = Schemas["Change"];
export type Correction = Schemas["Correction"];
export type CorrectionList = Schemas["CorrectionList"];
export type Created = Schemas["Created"];
export type FrameList = Schemas["FrameList"];
export type FrameView = Schemas["FrameView"];
export type GroundRequest = Schemas["GroundRequest"];
export type InstanceList = Schemas["InstanceList"];
export type InstanceView = Schemas["InstanceView"];
export type Job = Schemas["Job"];
export type JobError = Schemas["JobError"];
export type ModelList = Schemas["ModelList"];
export type Observer = Schemas["Observer"];
export type OrientedBox = Schemas["OrientedBox"];
export type Problem = Schemas["Problem"];
export type Scene = Schemas["Scene"];
export type SceneList = Schemas["SceneList"];
export type Finding = Schemas["Finding"];
export type SceneReport = Schemas["SceneReport"];
export type Support = Schemas["Support"];
export type Upload = Schemas["Upload"];
