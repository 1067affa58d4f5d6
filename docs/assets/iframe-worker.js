// A page that was opened as a file may not start a worker, and Material's search is one. There the
// search runs in a hidden frame instead. Material loads a file of this name for that purpose.
if (location.protocol === "file:") {
  window.Worker = class extends EventTarget {
    constructor(url) {
      super();
      const frame = document.createElement("iframe");
      frame.hidden = true;
      document.body.append(frame);
      const inside = frame.contentWindow;
      inside.document.open();
      inside.postMessage = (data) => this.dispatchEvent(new MessageEvent("message", { data }));
      const loaded = new Promise((resolve) => (inside.loaded = resolve));
      inside.document.write(`<script src="${url}"></script><script>loaded()</script>`);
      inside.document.close();
      this.postMessage = (data) =>
        loaded.then(() => inside.dispatchEvent(new MessageEvent("message", { data })));
      this.terminate = () => frame.remove();
    }
  };
}
