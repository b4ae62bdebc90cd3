import "./style/base.css";
import "./style/parts.css";
import "./style/places.css";
import "./style/room.css";
import { render } from "preact";
import { App } from "./app";

render(<App />, document.getElementById("page")!);
