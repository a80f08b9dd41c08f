// A world that takes three ticks for a frame, and in frame 5 has an object whose name no prefix begins.
using System.Collections.Generic;
using Caviar;

internal sealed class Slow : World
{
    private int _ticks;

    protected override void Prepare() { Prefixes.Add("car"); }

    protected override IEnumerable<WorldObject> Step(double t, double previous, IList<Command> commands)
    {
        if (++_ticks % 3 != 0) return null;
        return new[] { new WorldObject(Frame < 5 ? "car" : "lorry", "car", new[] { t, _ticks, 0.75 },
            new[] { 4.5, 1.8, 1.5 }) };
    }

    private static int Main(string[] arguments) { return new Slow().Run(arguments[0], arguments[1]); }
}
