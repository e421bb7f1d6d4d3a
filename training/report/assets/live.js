"use strict";

// Asks the server of a running episode for newer content until the episode is over.
(async () => {
  const status = document.querySelector("header").appendChild(document.createElement("p"));
  status.id = "status";
  status.textContent = "The episode begins.";
  let version = 0;
  try {
    for (;;) {
      const answer = await fetch(`content?after=${version}`);
      if (!answer.ok) throw new Error(answer.statusText);
      const content = await answer.json();
      if (content.page) document.dispatchEvent(new CustomEvent("content", { detail: content }));
      version = content.version;
      if (content.over) break;
      status.textContent = "The episode is running.";
    }
    status.textContent = "The episode is over; the run folder will have its report.";
  } catch {
    status.textContent = "The run was stopped: no more content arrives.";
  }
})();
