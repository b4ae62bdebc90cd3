// Parses the sample scan once for all tests, and prints the folder it is in: UNIGROUND_SAMPLE_DATA=$(node tests/support/prepare.js)

import { parsedSample, startService } from "./service.js";

const service = await startService({ empty: true });
await parsedSample(service.api);
await service.stop(true);
console.log(service.data);
