// Browsers refuse a Worker on pages opened as files. There an iframe takes its place, so
// that the search works without a server. Read by every page; docs/tools/hooks.py.
if (location.protocol === "file:")
  window.Worker = class extends EventTarget {
    constructor(url) {
      super()
      const frame = document.createElement("iframe")
      frame.hidden = true
      document.body.appendChild(frame)
      this.inside = frame.contentWindow
      window.addEventListener("message", event => {
        if (event.source === this.inside)
          this.dispatchEvent(new MessageEvent("message", { data: event.data }))
      })
      const load = "postMessage = data => parent.postMessage(data, '*');"
      this.ready = new Promise(done => (frame.onload = done))
      const page = this.inside.document
      page.open()
      page.write(`<script>${load}</script><script src="${url}"></script>`)
      page.close()
    }
    postMessage(data) {
      this.ready.then(() =>
        this.inside.dispatchEvent(new MessageEvent("message", { data }))
      )
    }
  }
