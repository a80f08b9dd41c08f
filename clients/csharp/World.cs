// A world with Caviar.cs: a car on a circle, a UAV that agents may steer, a van that comes and goes.
//
//     mcs -out:World.exe World.cs Caviar.cs
//     mono World.exe ws://127.0.0.1:8080/ws world
//
// A token of the service, where the broker has tokens, is taken from CAVIAR_TOKEN.
using System;
using System.Collections.Generic;
using System.Linq;
using Caviar;

internal sealed class Street : World
{
    private const double Radius = 20, Speed = 10; // of the car [m, m/s]
    private OfferedMesh _car;
    private double[] _uav, _wanted; // position [m]; velocity that was commanded [m/s], or null
    // A wedge: x forward, y left, z up; objects scale it to their dimensions.
    private static readonly double[][] Wedge =
        { V(-1, -1, 0), V(1, -1, 0), V(1, 1, 0), V(-1, 1, 0), V(-1, -1, 1), V(-1, 1, 1) };
    private static readonly int[][] Sides =
        { T(0, 3, 2), T(0, 2, 1), T(0, 1, 4), T(3, 5, 2), T(0, 4, 5), T(0, 5, 3), T(1, 2, 5), T(1, 5, 4) };

    protected override void Prepare()
    {
        Prefixes.AddRange(new[] { "car", "uav", "van" });
        _car = OfferMesh("car", Wedge, Sides);
        double[][] ground = { V(-60, -60, 0), V(60, -60, 0), V(60, 60, 0), V(-60, 60, 0) };
        double[][] wall = { V(30, 30, 0), V(30, -30, 0), V(30, -30, 12), V(30, 30, 12) };
        int[][] square = { T(0, 1, 2), T(0, 2, 3) };
        OfferScenery(
            new[]
            {
                new SceneryMesh("ground", ground, square, "asphalt"), new SceneryMesh("wall", wall, square, "brick"),
            },
            new[] { new Material("asphalt", "concrete"), new Material("brick", "brick", 0.3) });
    }

    protected override void Reset(long seed, double t0)
    {
        _uav = V(5, -5 - seed % 7, 15);
        _wanted = null;
    }

    protected override IEnumerable<WorldObject> Step(double t, double previous, IList<Command> commands)
    {
        foreach (var command in commands)
            if (command.Type == "velocity" && command.Object == "uav") _wanted = command.Velocity;
        var velocity = _wanted ?? V(3 * Math.Cos(0.4 * t), 3 * Math.Sin(0.4 * t), 0);
        _uav = _uav.Zip(velocity, (x, v) => x + v * (t - previous)).ToArray();

        double turning = Speed / Radius, angle = turning * t, heading = angle + Math.PI / 2;
        var place = V(Radius * Math.Cos(angle), Radius * Math.Sin(angle), 0.75);
        var objects = new List<WorldObject>
        {
            new WorldObject("car", "car", place, V(4.5, 1.8, 1.5))
            {
                Orientation = Quaternions.FromEuler(heading), Mesh = _car.Mesh,
                AngularVelocity = V(0, 0, turning),
                Velocity = V(Speed * Math.Cos(heading), Speed * Math.Sin(heading), 0),
            },
            new WorldObject("uav", "uav", _uav, V(0.6, 0.6, 0.25)) { Velocity = velocity },
        };
        double passing = t % 10 - 2; // of the van: it is there from 2 s until 7 s of every 10 s
        if (passing >= 0 && passing < 5)
        {
            var van = new WorldObject("van", "truck", V(-40 + 16 * passing, 26, 1.25), V(5.5, 2.1, 2.5));
            van.Velocity = V(16, 0, 0);
            van.Mesh = OfferMesh("van", Wedge, Sides, "metal").Mesh; // it comes while the run goes on
            objects.Add(van);
        }
        return objects;
    }

    protected override byte[] Save()
    {
        return _uav.Concat(_wanted ?? new double[0]).SelectMany(BitConverter.GetBytes).ToArray();
    }

    protected override void Restore(byte[] state)
    {
        var numbers = Enumerable.Range(0, state.Length / 8)
            .Select(i => BitConverter.ToDouble(state, 8 * i)).ToArray();
        _uav = numbers.Take(3).ToArray();
        _wanted = numbers.Length == 6 ? numbers.Skip(3).ToArray() : null;
    }

    private static double[] V(double x, double y, double z) { return new[] { x, y, z }; }
    private static int[] T(int a, int b, int c) { return new[] { a, b, c }; }

    private static int Main(string[] arguments)
    {
        var street = new Street { Implementation = "street in C#" };
        street.Listen("action");
        return street.Run(arguments[0], arguments[1], Environment.GetEnvironmentVariable("CAVIAR_TOKEN"));
    }
}
