// A world that takes three ticks for a frame, and in frame 5 has an object whose name no prefix begins. With the
// setting `how` it answers at once, with its times in the object's position, fails or is late.
using System;
using System.Collections.Generic;
using System.Threading;
using Caviar;

internal sealed class Slow : World
{
    private int _ticks;

    protected override void Prepare() { Prefixes.Add("car"); }

    protected override IEnumerable<WorldObject> Step(double t, double previous, IList<Command> commands)
    {
        string how = Settings.Text("how");
        if (how == "fail") throw new InvalidOperationException("it fails");
        if (how == "late") Thread.Sleep(1500);
        if (how == "" && ++_ticks % 3 != 0) return null;
        double y = how == "" ? _ticks : previous;
        return new[] { new WorldObject(Frame < 5 ? "car" : "lorry", "car", new[] { t, y, 0.75 },
            new[] { 4.5, 1.8, 1.5 }) };
    }

    private static int Main(string[] arguments) { return new Slow().Run(arguments[0], arguments[1]); }
}
