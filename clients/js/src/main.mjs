// A service as a program: on the command line of Node, or as a page.
import { CaviarError } from "./errors.mjs";

/** @import { Service } from "./service.mjs" */

/** Exit status of a process that SIGTERM ended, as shells count it. */
const TERMINATED = 143;
/** [ms] after which a process that was told to end ends, whatever it waits for. */
const END_MS = 1000;

/**
 * Run a service until its run is over.
 *
 * In Node `URL [NAME]` are the arguments of the program and the token is in the variable CAVIAR_TOKEN; it
 * says BYE at SIGTERM, and the exit status is 0 only where the run ended. In a page they are
 * `?url=…&name=…&token=…` of its address.
 *
 * @param {Service} service
 * @param {string} url  where none is given
 * @returns {Promise<string>} why the run ended, or what went wrong
 */
export async function main(service, url = "ws://127.0.0.1:8080/ws") {
  const { process } = /** @type {{ process?: NodeJS.Process }} */ (globalThis);
  const inNode = process?.versions?.node !== undefined;
  const query = new URLSearchParams(inNode ? "" : globalThis.location?.search);
  const [given, name] = inNode ? process.argv.slice(2) : [query.get("url"), query.get("name")];
  const token = (inNode ? process.env.CAVIAR_TOKEN : query.get("token")) ?? "";
  service.name = name || service.name;
  if (inNode) {
    process.once("SIGTERM", () => {
      process.exitCode = TERMINATED;
      service.leave("SIGTERM");
      setTimeout(() => process.exit(TERMINATED), END_MS).unref();
    });
  }
  let told;
  try {
    told = await service.run(given || url, { token });
    console.log(`${service.name}: the run ended: ${told}`);
  } catch (error) {
    const { message, stack } = /** @type {Error} */ (error);
    // What the library says is for the user; anything else is a fault of a program, and has a place in it.
    told = error instanceof CaviarError ? message : (stack ?? message);
    console.error(`${service.name}: ${told}`);
    if (inNode) process.exitCode = 1;
  }
  return told;
}
