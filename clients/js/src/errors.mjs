// Errors of the library: what the peer did wrong, what the user of the library did wrong, and what ended a
// run.
//
//   CaviarError
//     ProtocolError   bytes that are no message or no payload of the protocol; `code` as in ERROR
//     SceneError      objects, meshes or devices that no consumer would accept
//     RunError        the run cannot go on: refused, lost, or failed

/** Base of all errors that this library throws on purpose. */
export class CaviarError extends Error {
  /** @param {string} message */
  constructor(message) {
    super(message);
    this.name = new.target.name;
  }
}

/** Bytes that are no message, or no payload, of the protocol. */
export class ProtocolError extends CaviarError {
  /**
   * @param {"malformed" | "limit" | "version" | "unexpected" | "unknown-asset"} code  as in the message ERROR
   * @param {string} message  what is wrong, and where
   */
  constructor(code, message) {
    super(message);
    this.code = code;
  }
}

/** Objects, meshes or devices that consumers would refuse; names the object, the field and the value. */
export class SceneError extends CaviarError {}

/** The run ended for this service: it was refused, its broker is gone, or its own code failed. */
export class RunError extends CaviarError {}
