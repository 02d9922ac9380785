// STOP and PAUSE are plain requests, so that they work while the page reconnects.
"use strict";

const live = {
  head(html, running) {
    document.getElementById("head").innerHTML = html;
    document.getElementById("actions").hidden = !running;
    document.title = document.querySelector("#head .now").textContent + " · jaxcal";
  },

  async ask(what) {
    const answer = document.getElementById("answer");
    answer.className = "";
    answer.textContent = "Asking the session to " + what + " …";
    const late = setTimeout(() => {
      answer.textContent = "NO ANSWER: use the emergency stop";
      answer.className = "bad";
    }, 1000);
    try {
      const reply = await fetch("/" + what, { method: "POST" });
      answer.textContent = await reply.text();
      answer.className = reply.ok ? "good" : "bad";
    } catch {
      answer.textContent =
        "NOT SENT: the page has lost its server. Press Ctrl-C twice in the terminal, " +
        "run jaxcal-rig stop, or use the emergency stop.";
      answer.className = "bad";
    } finally {
      clearTimeout(late);
    }
  },
};

for (const what of ["pause", "stop"])
  document.getElementById(what).addEventListener("click", () => live.ask(what));
