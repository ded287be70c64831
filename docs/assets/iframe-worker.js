/* Search without a server: browsers refuse web workers on file:// pages, so the worker runs in a hidden frame. */
(() => {
  if (location.protocol !== "file:") return;
  window.Worker = class extends EventTarget {
    constructor(url) {
      super();
      this.frame = document.createElement("iframe");
      this.frame.hidden = true;
      document.body.append(this.frame);
      const inside = this.frame.contentWindow;
      const send = (data) => {
        const event = new MessageEvent("message", { data });
        this.dispatchEvent(event);
        if (this.onmessage) this.onmessage(event);
      };
      this.loaded = new Promise((done) => {
        inside.postMessage = send;
        inside.importScripts = (...urls) =>
          Promise.all(urls.map((one) => new Promise((ready, failed) => {
            const script = inside.document.createElement("script");
            Object.assign(script, { src: one, onload: ready, onerror: failed });
            inside.document.body.append(script);
          })));
        const script = inside.document.createElement("script");
        Object.assign(script, { src: url, onload: done });
        inside.document.body.append(script);
      });
    }
    postMessage(data) {
      const inside = this.frame.contentWindow;
      this.loaded.then(() => inside.dispatchEvent(new inside.MessageEvent("message", { data })));
    }
    terminate() {
      this.frame.remove();
    }
  };
})();
