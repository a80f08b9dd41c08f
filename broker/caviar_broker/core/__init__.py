"""The frame clock and its rules: events and the time go in, actions come out.

Nothing here opens a socket, starts a thread or reads a clock, so that real time, as-fast-as-possible,
embedded runs, replays and the tests in virtual time are all thin shells around one core.

From a DONE to the next GRANT:

1. The shell gives the event to `clock.FrameClock.handle`, which looks the transition up and calls
2. `episodes.Episodes.handle_done`, which refuses a DONE of another epoch or frame;
3. `dispatch.Dispatcher.handle_done` ends the task, and `decisions.DecisionTable.decide_answered` decides its
   products, as `decisions.Deadlines` does for a service that is late (held, absent, or the end of the run);
4. each decision is entered into the ledger and becomes a Journal action.
5. When all events of a turn are handled, the shell calls `FrameClock.settle`:
6. `Episodes.pump` and `Dispatcher.advance` find the services whose inputs are all decided, and order a GRANT.
7. Whatever a step wants done (a message, a notice, a journal entry) is appended to the one list
   `Run.actions`, in order. The shell takes `FrameClock.actions`, and sends; a GRANT that depends on a journal
   entry waits until the entry is written.
"""
